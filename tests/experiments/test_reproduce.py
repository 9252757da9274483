"""A study is finished exactly once, however often it is begun, and drawn from what there is."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from mbdpg.agents import td3
from mbdpg.experiments import reproduce as module
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.launch import Local, Work
from mbdpg.experiments.reproduce import Training, reproduce
from mbdpg.experiments.run import train
from mbdpg.experiments.studies import SCALES, Cell, Panel, Study
from mbdpg.interfaces import UserError
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
        for work in works:
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
    empty = tmp_path / "Pendulum-v1" / "td3" / "seed-1"
    empty.mkdir()  # a process died before it had anything to go on from
    (empty / "config.json").write_text("{}")
    said = begin(tmp_path)
    assert launched == [f"Pendulum-v1 {label} seed {seed}" for label in ("td3", "td3-width=5") for seed in (0, 1)]
    assert (begun / "metrics.jsonl").read_bytes().startswith(first_rows)
    assert "figure-8: 4 of 4 to do" in said and (tmp_path / "figure-8.png").stat().st_size > 1000
    assert any(line.startswith("  td3 width=5 (2 seeds) at 40: ") for line in said)
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
    with pytest.raises(UserError, match=r"1 of 2 failed \(see .*logs\); the figure lacks them"):
        begin(tmp_path, seeds=[0])
    assert {row["label"] for row in numbers(tmp_path)} == {"td3 width=5"}
    work = Training(STUDY.panels[0].cells[0].config, (0,), tmp_path / "Pendulum-v1" / "td3")
    with pytest.raises(UserError, match="has other settings than this study's; move it away"):
        work(lambda: False)


def test_an_expert_without_success_fails_alone(launched: list[str], tmp_path: Path, monkeypatch: Any) -> None:
    taught = dataclasses.replace(cell("td3 taught"), demonstrated=True)
    study = dataclasses.replace(STUDY, panels=(Panel("demonstrations", (cell("td3"), taught)),))
    monkeypatch.setattr(module, "study", lambda name, scale: study)
    scale = dataclasses.replace(
        SCALES["smoke"], expert_steps=100, success_return=1e6, tiny={"width": 4, "batch_size": 4, "random_steps": 50}
    )
    monkeypatch.setitem(SCALES, "quick", scale)
    with pytest.raises(UserError, match="2 of 3 failed"):
        begin(tmp_path, seeds=[0])
    assert launched[0] == "Pendulum-v1 expert"
    assert {row["label"] for row in numbers(tmp_path)} == {"td3"}
