"""A study is finished exactly once, however often it is begun, and drawn from what there is."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import pytest

from mbdpg.agents import td3
from mbdpg.agents.mbdpg import Config as MBDPGConfig
from mbdpg.experiments import reproduce as module
from mbdpg.experiments.config import EnvOptions, RunConfig
from mbdpg.experiments.launch import Work
from mbdpg.experiments.pool import Local
from mbdpg.experiments.reproduce import reproduce
from mbdpg.experiments.run import train
from mbdpg.experiments.studies import SCALES, Cell, Model, Panel, Study
from mbdpg.experiments.work import Training, is_made_as, origin_of, refuse_made_otherwise, say_made_as
from mbdpg.interfaces import UserError
from mbdpg.storage.run_folder import RunFolder, only_writer
from mbdpg.training.loop import Schedule

SCHEDULE = Schedule(steps=40, cycle=10, evaluate_every=20, evaluation_episodes=1, log_every=20, checkpoint_every=20)
AGENT = td3.Config(width=4, batch_size=4, random_steps=20)


def cell(label: str, **settings: Any) -> Cell:
    return Cell(label, RunConfig("Pendulum-v1", dataclasses.replace(AGENT, **settings), SCHEDULE))


STUDY = Study("figure-8", "nothing", (Panel("width", (cell("td3"), cell("td3 width=5", width=5))),))


@pytest.fixture
def launched(toy: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Work is done in this process, by toys; gives the names of what was done."""
    done: list[str] = []

    def launch(works: Sequence[Work], engine: Any, **others: Any) -> dict[str, str]:
        failures = {}
        for work in (work for work in works if not work.finished()):
            done.append(work.name)
            try:
                work(lambda: False)
            except UserError as error:
                failures[work.name] = str(error)
        return failures

    monkeypatch.setattr(module, "launch", launch)
    monkeypatch.setattr(module, "study", lambda name, scale: STUDY)
    with toy.learned_by_toys():
        yield done


def begin(out: Path, seeds: Sequence[int] = (0, 1)) -> list[str]:
    said: list[str] = []
    reproduce("figure-8", "quick", out, Local(1), seeds=seeds, say=said.append)
    return said


def numbers(out: Path) -> list[dict[str, str]]:
    with open(out / "figure-8.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_what_is_finished_is_skipped_and_what_was_begun_goes_on(launched: list[str], tmp_path: Path) -> None:
    half = dataclasses.replace(STUDY.panels[0].cells[0].config, schedule=dataclasses.replace(SCHEDULE, steps=20))
    (begun,) = train(half, seeds=[0], out=tmp_path / "Pendulum-v1" / "td3")
    first_rows = (begun / "metrics.jsonl").read_bytes()
    # A process died before it had anything to go on from.
    empty = RunFolder.create(tmp_path / "Pendulum-v1" / "td3" / "seed-1", half.to_json() | {"seed": 1})
    (empty.path / "checkpoints").mkdir()
    said = begin(tmp_path)
    assert launched == [f"Pendulum-v1 {label} seed {seed}" for label in ("td3", "td3-width=5") for seed in (0, 1)]
    assert (begun / "metrics.jsonl").read_bytes().startswith(first_rows)
    assert "figure-8: 4 of 4 to do" in said and (tmp_path / "figure-8.png").stat().st_size > 1000
    assert any(re.match(r"\| td3 width=5 +\| 2 +\| 40 +\| -", line) for line in said)
    text = (tmp_path / "figure-8.md").read_text()
    assert text.startswith(
        "# figure-8\n\n`mbdpg reproduce figure-8 --scale quick --seeds 0 1`\n\nThe paper says: nothing"
    )
    assert "- 4 of 4: commit " in text
    found = {(row["label"], row["seed"], row["env_steps"]) for row in numbers(tmp_path)}
    assert found == {(l, s, n) for l in ("td3", "td3 width=5") for s in "01" for n in ("0", "20", "40")}
    launched.clear()
    assert "figure-8: 0 of 4 to do" in begin(tmp_path) and launched == []
    begin(tmp_path, seeds=[2])
    assert launched == [f"Pendulum-v1 {label} seed 2" for label in ("td3", "td3-width=5")]


def test_a_run_with_other_settings_is_not_taken_for_the_studys(launched: list[str], tmp_path: Path) -> None:
    other = dataclasses.replace(STUDY.panels[0].cells[0].config, agent=dataclasses.replace(AGENT, batch_size=5))
    train(
        dataclasses.replace(other, schedule=dataclasses.replace(SCHEDULE, steps=20)),
        seeds=[0],
        out=tmp_path / "Pendulum-v1" / "td3",
    )
    with pytest.raises(UserError, match=r"1 of 2 failed or were left out \(see .*logs\); the figure lacks them"):
        begin(tmp_path, seeds=[0])
    assert {row["label"] for row in numbers(tmp_path)} == {"td3 width=5"}
    work = Training(STUDY.panels[0].cells[0].config, (0,), tmp_path / "Pendulum-v1" / "td3")
    with pytest.raises(UserError, match="has other settings than this one's; move it away"):
        work(lambda: False)


@pytest.mark.parametrize("name", ["config.json", "metrics.jsonl"])
def test_a_damaged_run_fails_alone_and_is_left_as_it_is(launched: list[str], tmp_path: Path, name: str) -> None:
    """Nothing of the study could be done."""
    begin(tmp_path, seeds=[0])
    damaged = tmp_path / "Pendulum-v1" / "td3" / "seed-0" / name
    damaged.write_text("{}\n" * 2)
    with pytest.raises(UserError, match="1 of 4 failed"):
        begin(tmp_path)
    assert damaged.read_text() == "{}\n" * 2
    found = {(row["label"], row["seed"]) for row in numbers(tmp_path)}
    assert found == {("td3", "1"), ("td3 width=5", "0"), ("td3 width=5", "1")}
    assert (
        "\n\nNot finished, for it failed or was left out: Pendulum-v1 td3 seed 0.\n\n"
        in (tmp_path / "figure-8.md").read_text()
    )


def test_a_run_that_failed_in_the_middle_does_not_cut_the_others_short(
    launched: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    half = dataclasses.replace(STUDY.panels[0].cells[0].config, schedule=dataclasses.replace(SCHEDULE, steps=20))
    train(half, seeds=[0], out=tmp_path / "Pendulum-v1" / "td3")

    def fails(runs: Sequence[Path], **others: Any) -> None:
        if runs:
            raise UserError("the disk is full")

    monkeypatch.setattr("mbdpg.experiments.work.resume", fails)
    with pytest.raises(UserError, match="1 of 4 failed"):
        begin(tmp_path)
    assert {(row["label"], row["seed"]) for row in numbers(tmp_path)} >= {("td3", "1")}
    text = (tmp_path / "figure-8.md").read_text()
    assert re.search(r"\| td3 +\| 1 +\| 40 ", text) and "left out: Pendulum-v1 td3 seed 0." in text


def test_an_expert_without_success_fails_alone(launched: list[str], tmp_path: Path, monkeypatch: Any) -> None:
    taught = dataclasses.replace(cell("td3 taught"), demonstrated=True)
    study = dataclasses.replace(STUDY, panels=(Panel("demonstrations", (cell("td3"), taught)),))
    monkeypatch.setattr(module, "study", lambda name, scale: study)
    scale = dataclasses.replace(
        SCALES["smoke"], expert_steps=100, success_share=1.0, tiny={"width": 4, "batch_size": 4, "random_steps": 50}
    )
    monkeypatch.setattr(module.expert, "success_in", lambda env, options, given: 1e6)
    monkeypatch.setitem(SCALES, "quick", scale)
    with pytest.raises(UserError, match="2 of 3 failed"):
        begin(tmp_path, seeds=[0])
    assert launched[0] == "Pendulum-v1 expert"
    assert {row["label"] for row in numbers(tmp_path)} == {"td3"}


def test_a_folder_that_is_no_run_is_never_deleted(launched: list[str], tmp_path: Path) -> None:
    seed = tmp_path / "td3" / "seed-0"
    seed.mkdir(parents=True)
    (seed / "thesis.txt").write_text("years of work")
    work = Training(STUDY.panels[0].cells[0].config, (0,), tmp_path / "td3")
    with pytest.raises(UserError, match="is not a run folder"):
        work(lambda: False)
    run = RunFolder.create(tmp_path / "other" / "seed-0", work.config.to_json() | {"seed": 0})
    (run.path / "thesis.txt").write_text("years of work")
    with pytest.raises(UserError, match="has no checkpoint, but has 'thesis.txt'; move it away"):
        dataclasses.replace(work, out=tmp_path / "other")(lambda: False)
    assert (seed / "thesis.txt").exists() and (run.path / "thesis.txt").exists()


@pytest.mark.parametrize("left", [(), (".tmp-config.json",), (".tmp-config.json", "lock")])
def test_a_run_that_died_before_its_config_was_there_is_begun_again(
    launched: list[str], tmp_path: Path, left: tuple[str, ...]
) -> None:
    """It was refused as no run folder, every time."""
    run = tmp_path / "td3" / "seed-0"
    run.mkdir(parents=True)
    for name in left:
        (run / name).touch()
    work = Training(STUDY.panels[0].cells[0].config, (0,), tmp_path / "td3")
    work(lambda: False)
    assert work.finished() and not (run / ".tmp-config.json").exists()


def test_a_run_of_ones_own_task_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launched: list[str]
) -> None:
    """--allow-import was given, and not believed when a trial was begun again."""
    (tmp_path / "own_task.py").write_text(
        "import gymnasium\ngymnasium.registry['Own-v0'] = gymnasium.spec('Pendulum-v1')"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(gymnasium.registry, "Own-v0", None)
    config = RunConfig("own_task:Own-v0", AGENT, SCHEDULE, EnvOptions(allow_import=True))
    work, asked = Training(config, (0,), tmp_path / "runs"), itertools.count()
    work(lambda: next(asked) > 6)
    assert not work.finished() and any(work.runs()[0].glob("checkpoints/0*"))
    work(lambda: False)
    assert work.finished()


def test_a_run_that_another_process_begins_is_left_alone(launched: list[str], tmp_path: Path) -> None:
    work = Training(STUDY.panels[0].cells[0].config, (0,), tmp_path / "td3")
    run = RunFolder.create(tmp_path / "td3" / "seed-0", work.config.to_json() | {"seed": 0})
    with run.locked(), pytest.raises(UserError, match="seed-0 is in use by pid"):
        work(lambda: False)
    assert (run.path / "config.json").exists()


def test_a_run_without_its_last_evaluation_is_not_finished(launched: list[str], tmp_path: Path) -> None:
    """A stop in the last cycle leaves a checkpoint of the last step."""
    work = Training(STUDY.panels[0].cells[0].config, (0,), tmp_path / "td3")
    work(lambda: False)
    assert work.finished()
    metrics = work.runs()[0] / "metrics.jsonl"
    rows = metrics.read_bytes().splitlines(keepends=True)
    metrics.write_bytes(b"".join(row for row in rows if b'"eval", "env_steps": 40' not in row))
    assert not work.finished()


def test_a_second_reproduce_in_the_same_folder_is_refused(launched: list[str], tmp_path: Path) -> None:
    with only_writer(tmp_path), pytest.raises(UserError, match="is in use by pid .*; stop it or choose another --out"):
        begin(tmp_path)
    assert launched == []


def test_demonstrations_and_errors_of_another_scale_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "seed-0.csv"
    say_made_as(file, {"updates": 20})
    assert not is_made_as(file, {"updates": 20})
    file.write_text("depth")
    assert is_made_as(file, {"updates": 20})
    assert origin_of(file).keys() == {"commit", "machine"}
    with pytest.raises(UserError, match="seed-0.csv was made with other settings; move it away"):
        refuse_made_otherwise(file, {"updates": 3000})
    note = tmp_path / "seed-0.csv.settings.json"
    note.write_text('{"updates": 20}')  # of before origins were noted
    assert is_made_as(file, {"updates": 20}) and origin_of(file) == {}
    note.write_text('{"updates": 20, "origin": {"commit": "another"}}')
    assert is_made_as(file, {"updates": 20}) and origin_of(file) == {"commit": "another"}
    for damaged in ("{", "[]", ""):
        note.write_text(damaged)
        with pytest.raises(UserError, match="seed-0.csv was made with other settings"):
            refuse_made_otherwise(file, {"updates": 20})


def test_demonstrations_of_another_expert_fail_what_needs_them_and_nothing_else(
    launched: list[str], tmp_path: Path, monkeypatch: Any
) -> None:
    """They stopped the whole study, and nothing was drawn."""
    taught = dataclasses.replace(cell("td3 taught"), demonstrated=True)
    study = dataclasses.replace(STUDY, panels=(Panel("demonstrations", (cell("td3"), taught)),))
    monkeypatch.setattr(module, "study", lambda name, scale: study)
    others = tmp_path / "Pendulum-v1" / "demonstrations.safetensors"
    say_made_as(others, {"expert": "another"})
    others.write_bytes(b"recorded for days")
    with pytest.raises(UserError, match="2 of 3 failed"):
        begin(tmp_path, seeds=[0])
    assert launched == ["Pendulum-v1 expert", "Pendulum-v1 td3 seed 0"]
    assert others.read_bytes() == b"recorded for days" and {row["label"] for row in numbers(tmp_path)} == {"td3"}
    failed = "left out: Pendulum-v1 expert; Pendulum-v1 td3-taught seed 0."
    assert failed in (tmp_path / "figure-8.md").read_text()


def test_models_whose_recording_fails_are_named_and_not_tried(
    launched: list[str], tmp_path: Path, monkeypatch: Any
) -> None:
    """It said that there was nothing to prepare."""
    models = (Model("one", "Pendulum-v1", MBDPGConfig()), Model("two", "Pendulum-v1", MBDPGConfig(gaussians=1)))
    study = dataclasses.replace(STUDY, panels=(Panel("models", models=models),))
    monkeypatch.setattr(module, "study", lambda name, scale: study)
    (tmp_path / "Pendulum-v1" / "recorded" / "seed-0").mkdir(parents=True)
    (tmp_path / "Pendulum-v1" / "recorded" / "seed-0" / "thesis.txt").write_text("years of work")
    said: list[str] = []
    with pytest.raises(UserError, match="3 of 3 failed or were left out"):
        reproduce("figure-8", "smoke", tmp_path, Local(1), say=said.append)
    assert launched == ["Pendulum-v1 recorded seed 0"]
    assert "Pendulum-v1 two seed 0: left out, it needs Pendulum-v1 recorded seed 0" in said
