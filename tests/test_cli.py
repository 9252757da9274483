"""Each verb once, and what a person reads who got something wrong: one line, a status, and nothing left behind."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest

import mbdpg
from mbdpg.cli import VERBS, main
from mbdpg.experiments import expert
from mbdpg.experiments.pool import Local
from mbdpg.interfaces import UserError
from mbdpg.storage.run_folder import RunFolder

Start = Callable[..., "subprocess.Popen[str]"]
TINY = (
    *("--algorithm", "td3", "--width", "3", "--random-steps", "20", "--cycle", "10", "--steps", "40"),
    *("--evaluate-every", "20", "--evaluation-episodes", "1", "--log-every", "20", "--checkpoint-every", "20"),
    *("--max-episode-steps", "15"),
)


class Said(NamedTuple):
    status: int
    out: str
    err: str


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Said]:
    """Runs the command line in this process, in an empty folder."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setattr("mbdpg.cli.resume.keep_compilations", lambda: None)

    def run(*arguments: str | Path) -> Said:
        capsys.readouterr()
        status: Any = 0
        try:
            main([str(argument) for argument in arguments])
        except SystemExit as stop:
            status = stop.code
        captured = capsys.readouterr()
        if isinstance(status, str):  # the interpreter prints it and exits with 1
            return Said(1, captured.out, captured.err + status + "\n")
        return Said(status or 0, captured.out, captured.err)

    return run


@pytest.fixture
def toys(toy: Any) -> Iterator[None]:
    with toy.learned_by_toys():
        yield


def check_refused(said: Said, *texts: str, status: int = 1) -> None:
    assert said.status == status
    assert said.err.count("\n") == 1 and said.err.startswith("mbdpg")
    assert "Traceback" not in said.err and "unexpected" not in said.err
    for text in texts:
        assert text in said.err
    assert len(said.err) < 700


# Each verb once.


def test_train_then_resume_then_evaluate(say: Any, toys: None, tmp_path: Path) -> None:
    said = say("train", "Pendulum-v1", *TINY, "--seeds", "0", "4", "--out", tmp_path / "run")
    assert said.status == 0, said.err
    assert said.out == (
        f"done: {tmp_path}/run, learning curve in {tmp_path}/run/learning-curve.png\n"
        f"next: mbdpg evaluate {tmp_path}/run/seed-0 --episodes 10 --video {tmp_path}/run/policy.mp4\n"
    )
    assert [line.split()[1] for line in said.err.splitlines()] == ["0/40", "20/40", "40/40"]
    names = sorted(path.name for path in (tmp_path / "run").iterdir())
    assert names == ["learning-curve.png", "seed-0", "seed-4"]

    said = say("resume", tmp_path / "run", "--steps", "60")  # a folder of runs
    assert said.status == 0, said.err
    assert said.out.startswith(f"done: {tmp_path}/run, learning curve in {tmp_path}/run/learning-curve.png\n")
    for seed in (0, 4):
        assert (tmp_path / "run" / f"seed-{seed}" / "checkpoints" / "000000060").is_dir()

    said = say("evaluate", tmp_path / "run" / "seed-4", "--episodes", "2", "--best")
    assert said.status == 0 and said.err == ""
    first, second, mean = said.out.splitlines()
    assert first.startswith("episode 0: return -") and first.endswith(", 15 steps") and second.startswith("episode 1:")
    assert mean.startswith("2 episodes: return -") and mean.endswith(" 15 steps")
    again = say("evaluate", tmp_path / "run" / "seed-4", "--episodes", "2", "--best")
    assert again.out == said.out
    assert say("evaluate", tmp_path / "run" / "seed-4", "--episodes", "2", "--best", "--seed", "1").out != said.out


def test_one_seed_that_goes_on_keeps_the_others_in_the_picture(say: Any, toys: None, monkeypatch: Any) -> None:
    """It was drawn alone over the picture of all of them, and from within its folder, into that."""
    say("train", "Pendulum-v1", *TINY, "--seeds", "0", "4", "--out", "run")
    drawn: list[Any] = []
    monkeypatch.setattr("mbdpg.reports.curves.draw_curves", lambda *given, **_: drawn.append(given))
    for name in ("other", "damaged"):
        shutil.copytree("run/seed-0", f"run/{name}")
    config = Path("run/other/config.json")
    config.write_text(config.read_text().replace("Pendulum-v1", "Other-v1"))
    Path("run/damaged/config.json").write_text("{")
    whole = Path.cwd() / "run"
    said = say("resume", "run/seed-4", "--steps", "60")
    assert said.status == 0 and "mbdpg: not drawn: run/damaged is not a run folder" in said.err
    assert said.out.startswith("done: run, learning curve in run/learning-curve.png\nnext: mbdpg evaluate run/seed-4 ")
    monkeypatch.chdir("run/seed-4/policy")
    assert say("resume", "..", "--steps", "80").status == 0
    seeds = [Path("seed-0"), Path("seed-4")]
    assert drawn == [
        ({"td3": [folder / seed for seed in seeds]}, folder / "learning-curve.png") for folder in (Path("run"), whole)
    ]


def test_without_out_a_run_gets_a_folder_named_after_what_it_is(say: Any, toys: None) -> None:
    said = say("train", "Pendulum-v1", *TINY)
    assert said.status == 0, said.err
    (folder,) = Path("runs").iterdir()
    assert folder.name.startswith("Pendulum-v1-td3-") and (folder / "seed-0" / "metrics.jsonl").exists()


@pytest.mark.parametrize(("flags", "length"), [((), 32), (("--grounding-length", "7"), 7), (("--preset", "paper"), 8)])
def test_a_task_s_own_settings_hold_wherever_its_id_stands_and_flags_go_over_them(
    say: Any, toys: None, flags: Any, length: int
) -> None:
    task = ("LunarLanderContinuous-v3",)
    for i, order in enumerate(((*task, *TINY[2:], *flags), (*TINY[2:], *flags, *task))):
        said = say("train", *order, "--out", f"run{i}")
        assert said.status == 0, said.err
        assert RunFolder.open(Path(f"run{i}/seed-0")).config["agent"]["grounding_length"] == length


def test_evaluate_writes_a_video_without_a_display(mbdpg_command: Start, trained: Path, tmp_path: Path) -> None:
    # Not in this process: ffmpeg is forked, which JAX, once it computes, warns about.
    program = mbdpg_command("evaluate", trained, "--episodes", "1", "--video", tmp_path / "film.mp4", DISPLAY=None)
    stdout, stderr = program.communicate()
    assert (program.returncode, stderr) == (0, "")
    assert f"video of the first episode in {tmp_path}/film.mp4" in stdout
    assert (tmp_path / "film.mp4").stat().st_size > 10_000


def test_demonstrate_records_what_train_learns_from(say: Any, toys: None, tmp_path: Path, monkeypatch: Any) -> None:
    config_of = expert.config_of

    def short(env: str, steps: int, options: Any) -> Any:
        agent = mbdpg.TD3Config(width=3, random_steps=20)
        schedule = mbdpg.Schedule(
            steps, cycle=10, evaluate_every=20, evaluation_episodes=1, checkpoint_every=20, log_every=20
        )
        return dataclasses.replace(config_of(env, 50, options), agent=agent, schedule=schedule)

    monkeypatch.setattr(expert, "config_of", short)
    file = tmp_path / "good.safetensors"
    options = ("--episodes", "2", "--success-return", "-5000", "--max-episode-steps", "15")
    said = say("demonstrate", "Pendulum-v1", "--out", file, "--steps", "40", *options)
    assert said.status == 0, said.err
    assert "2 of 2 episodes were successes" in said.out
    assert f"demonstrations in {file}; they cost {40 + 2 * 15} environment steps" in said.out
    run = tmp_path / "good-expert" / "seed-0"
    again = say("demonstrate", "Pendulum-v1", "--out", tmp_path / "again.safetensors", "--expert", run, *options)
    assert (tmp_path / "again.safetensors").read_bytes() == file.read_bytes(), again.err
    said = say("train", "Pendulum-v1", *TINY, "--demonstrations", file, "--out", tmp_path / "run")
    assert said.status == 0, said.err
    first = json.loads((tmp_path / "run" / "seed-0" / "metrics.jsonl").read_text().splitlines()[0])
    assert first["expert_env_steps"] == 70
    taught = tmp_path / "run" / "seed-0"  # an expert that had one itself costs what both took
    said = say("demonstrate", "Pendulum-v1", "--out", tmp_path / "two.safetensors", "--expert", taught, *options)
    assert f"they cost {40 + 70 + 2 * 15} environment steps" in said.out, said.err
    assert sorted(path.name for path in Path.cwd().iterdir()) == []


# Help.


def test_the_overview_names_every_verb(say: Any) -> None:
    for arguments in ((), ("-h",), ("--help",)):
        said = say(*arguments)
        assert said.status == 0 and said.err == ""
        for verb in VERBS:
            assert f"mbdpg {verb} " in said.out


def test_the_version_is_said_with_those_that_a_report_of_a_fault_needs(say: Any) -> None:
    said = say("--version").out
    assert said.startswith(f"mbdpg {mbdpg.__version__}, jax {metadata.version('jax')}, ")
    assert said.endswith(f", python {platform.python_version()}\n")


@pytest.mark.parametrize("verb", VERBS)
def test_each_verb_s_help_explains_every_flag(say: Any, verb: str) -> None:
    said = say(verb, "--help")
    assert said.status == 0 and said.err == ""
    assert said.out.startswith(f"usage: mbdpg {verb}")
    flags = [line for line in said.out.splitlines() if line.lstrip(" │").startswith("--")]
    assert len(flags) >= 3
    assert "--debug" in said.out and "traceback" in said.out
    for word in ("_", "tuple[", "<class", "NoneType", "dataclass"):
        assert word not in said.out.replace("mbdpg_", ""), word


def test_train_s_help_shows_the_flags_of_the_algorithm_and_the_values_of_the_preset(say: Any) -> None:
    standard, td3, paper = (
        say("train", *flags, "--help").out
        for flags in ((), ("--algorithm", "td3"), ("--preset=paper", "--algorithm", "mbdpg"))
    )
    assert "--horizon" in standard and "--horizon" not in td3
    assert "--policy-delay" in td3 and "--policy-delay" not in standard
    assert "(default: 20)" in paper and "(default: 200000)" in paper
    lander = say("train", "LunarLanderContinuous-v3", "--help").out.split("--grounding-length")[1].split("--")[0]
    assert "32" in lander and "32" not in standard.split("--grounding-length")[1].split("--")[0]


# What a person can get wrong.


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("train",), "Gymnasium id"),
        (("train", "Pendulum-v1", "--wings", "2"), "--wings"),
        (("train", "Pendulum-v1", "--steps", "many"), "--steps"),
        (("train", "Pendulum-v1", "--gradient", "half"), "--gradient"),
        (("resume",), "run"),
        (("evaluate", "run", "--episodes", "1.5"), "--episodes"),
        (("demonstrate", "Pendulum-v1"), "--out"),
        (("reproduce", "figure-10"), "figure-10"),
        (("reproduce", "figure-4", "--scale", "huge"), "--scale"),
    ],
    ids=str,
)
def test_wrong_usage_is_one_line_and_status_2(say: Any, arguments: tuple[str, ...], said: str) -> None:
    check_refused(say(*arguments), f"mbdpg {arguments[0]}: ", said, status=2)
    assert list(Path.cwd().iterdir()) == []


def test_an_unknown_verb_is_answered_with_the_known_ones(say: Any) -> None:
    check_refused(say("fly"), "there is no verb 'fly'; expected one of train, resume, evaluate, demonstrate")


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("Pendulum-v9",), "Pendulum-v9 is not registered; nearest are"),
        (("CartPole-v1",), "expected a bounded 1-D Box of floats"),
        (("hostile:Env-v0",), "would run the code of the module hostile; if you trust it, pass --allow-import"),
        (("Pendulum-v1", "--steps", "325"), "--steps is 325, expected a multiple of --cycle, 50"),
        (("Pendulum-v1", "--steps", "0"), "--steps is 0, expected a number above 0"),
        (("Pendulum-v1", "--width", "0"), "--width is 0"),
        (("Pendulum-v1", "--discount", "1.5"), "--discount is 1.5, expected a number from 0 to 1"),
        (("Pendulum-v1", "--actor-learning-rate", "nan"), "--actor-learning-rate is nan"),
        (("Pendulum-v1", "--preset", "big"), "unknown --preset 'big'"),
        (
            ("Pendulum-v1", "--horizon=5", "--algorithm", "td3"),
            "--horizon is no setting of td3, but of mbdpg and pets;",
        ),
        (("Pendulum-v1", "--algorithm", "sac", "--no-terminal-value"), "--no-terminal-value is no setting of sac"),
        (("BipedalWalker-v3", "--algorithm", "mbpo", "--termination", "known", "--steps", "50"), "the rule of Biped"),
        (
            ("Pendulum-v1", "--algorithm", "ppo"),
            "unknown --algorithm 'ppo'; expected one of mbdpg, td3, sac, pets, mbpo",
        ),
        (("Pendulum-v1", "--seeds", "1", "1"), "--seeds are [1, 1], expected whole numbers from 0 to 2^31 - 1, one or"),
        (("Pendulum-v1", "--seeds", "-1"), "--seeds are [-1], expected whole numbers from 0"),
        (("Pendulum-v1", "--max-episode-steps", "0"), "--max-episode-steps is 0"),
        (("Pendulum-v1", "--observation-size", "27"), "only Ant-v5 lets you choose"),
        (("Pendulum-v1", "--reference-return", "nan"), "--reference-return is nan, expected a finite number"),
        (("",), "an empty id is not registered; nearest are"),
        (("Pendulum-v1", "--demonstrations", "missing.safetensors"), "missing.safetensors is missing"),
    ],
    ids=str,
)
def test_what_cannot_be_trained_is_refused_and_leaves_no_run_folder(say: Any, flags: Any, said: str) -> None:
    check_refused(say("train", *flags, "--out", "new/run"), said)
    assert list(Path.cwd().iterdir()) == []


def test_a_file_in_the_place_of_a_folder_is_named(say: Any) -> None:
    Path("file").write_text("mine")
    check_refused(say("train", "Pendulum-v1", "--out", "file/run"), "cannot create", "choose another --out")
    check_refused(say("resume", "file"), "file is not a folder; expected one that `mbdpg train --out` made")
    check_refused(say("evaluate", "file"), "file is not a folder")
    said = say("train", "Pendulum-v1", "--demonstrations", "file", "--out", "run")
    check_refused(said, "file is not a safetensors file", "expected an mbdpg demonstrations file")
    assert [path.name for path in Path.cwd().iterdir()] == ["file"]
    assert Path("file").read_text() == "mine"


@pytest.mark.parametrize("verb", ["resume", "evaluate"])
def test_a_missing_and_a_foreign_folder_are_named(say: Any, verb: str) -> None:
    check_refused(say(verb, "missing"), "missing is not a folder")
    Path("foreign").mkdir()
    (Path("foreign") / "config.json").write_text('{"model": "gpt"}')
    check_refused(say(verb, "foreign"), "foreign is not a run folder")
    (Path("foreign") / "config.json").write_bytes(b"\x80\x04\x95")
    check_refused(say(verb, "foreign"), "foreign is not a run folder", "not valid JSON")


def test_a_run_that_never_saved_anything_is_said_so(say: Any, trained: Path) -> None:
    shutil.copytree(trained, "run")
    shutil.rmtree("run/checkpoints")
    check_refused(say("resume", "run"), "no checkpoint to load", "none was saved yet")
    shutil.rmtree("run/policy")
    check_refused(say("evaluate", "run"), "has no latest.safetensors yet")


def test_a_folder_of_runs_is_answered_with_one_of_them(say: Any, trained: Path) -> None:
    shutil.copytree(trained, "runs/seed-0")
    check_refused(say("evaluate", "runs"), "runs is not a run folder", "expected one of its runs, such as runs/seed-0")
    said = say("demonstrate", "Pendulum-v1", "--out", "good.safetensors", "--expert", "runs")
    check_refused(said, "runs is not a run folder", "such as runs/seed-0")


def test_a_second_expert_in_the_same_place_is_refused_with_a_way_on(say: Any, trained: Path) -> None:
    shutil.copytree(trained, "good-expert/seed-0")
    said = say("demonstrate", "Pendulum-v1", "--out", "good.safetensors")
    check_refused(said, "has an expert already: take it with --expert good-expert/seed-0", "choose another --out")


def test_training_where_something_is_already_says_resume(say: Any, trained: Path) -> None:
    shutil.copytree(trained, "run/seed-0")
    before = sorted(path.name for path in Path("run").rglob("*"))
    check_refused(say("train", "Pendulum-v1", "--out", "run"), "is not empty", "resume it or choose another --out")
    check_refused(say("train", "Pendulum-v1", "--seeds", "7", "0", "--out", "run"), "is not empty")
    assert sorted(path.name for path in Path("run").rglob("*")) == before


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--episodes", "0"), "--episodes is 0, expected at least 1"),
        (("--seed", "-1"), "--seed is -1, expected at least 0"),
        (("--video", "film.gif"), "expected a name that ends in .mp4"),
        (("--video", "file/film.mp4"), "cannot write file/film.mp4"),
    ],
    ids=str,
)
def test_an_evaluation_that_cannot_be_is_refused(say: Any, trained: Path, flags: Any, said: str) -> None:
    Path("file").write_text("")
    check_refused(say("evaluate", trained, *flags), said)
    assert [path.name for path in Path.cwd().iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("Humanoid-v5",), "nobody knows what a success in Humanoid-v5 is; say so with --success-return"),
        (("Pendulum-v1", "--episodes", "0"), "--episodes is 0"),
        (("Pendulum-v1", "--expert", "missing", "--seed", "-1"), "--seed is -1, expected a whole number from 0 to 2^"),
        (("Pendulum-v1", "--steps", "30"), "--steps is 30"),
        (("Pendulum-v1", "--success-return", "nan"), "--success-return is nan, expected a finite number"),
        (("Pendulum-v1", "--expert", "missing"), "missing"),
        (("Pendulum-v9",), "is not registered"),
    ],
    ids=str,
)
def test_demonstrations_that_cannot_be_are_refused_before_an_expert_is_trained(say: Any, flags: Any, said: str) -> None:
    check_refused(say("demonstrate", *flags, "--out", "new/good.safetensors"), said)
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("figure-6", "--workers", "0"), "--workers is 0, expected at least 1"),
        (("figure-6", "--seeds", "-1"), "--seeds are [-1], expected whole numbers from 0 to 2^31 - 1"),
        (("figure-6", "--seeds", "1", "1"), "--seeds are [1, 1], expected whole numbers from 0 to 2^31 - 1, one or"),
        (("figure-6", "--address", "127.0.0.1:6379"), "--address, --gpus need --engine ray"),
        (("figure-6", "--engine", "ray", "--workers", "2"), "--workers is for this machine alone"),
        (("figure-6", "--out", "file"), "file cannot be a folder of studies"),
    ],
    ids=str,
)
def test_a_study_that_cannot_be_is_refused(say: Any, flags: Any, said: str) -> None:
    Path("file").write_text("")
    check_refused(say("reproduce", *flags), said)
    assert [path.name for path in Path.cwd().iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ((), "nothing is searched; say what with --search"),
        (("--search", "wings=1:2"), "'wings' is no setting"),
        (("--search", "width=1:2", "--out", "/dev/null"), "/dev/null cannot be the folder of a sweep"),
        (("--search", "width=1:2", "width=3:4"), "--search has a setting twice"),
        (("--search", "width=1:2", "--trials", "0"), "--trials is 0, expected at least 1"),
        (("--search", "width=1:2", "--seeds", "1", "1"), "--seeds are [1, 1], expected"),
        (("--search", "width=1:2", "--gpus"), "--address, --gpus need --engine ray"),
    ],
    ids=str,
)
def test_a_sweep_that_cannot_be_is_refused(say: Any, flags: Any, said: str) -> None:
    check_refused(say("sweep", "Pendulum-v1", *flags), said)
    check_refused(say("sweep", "NoSuchTask-v0", "--search", "width=1:2"), "NoSuchTask-v0")
    oracle = ("--algorithm", "mbpo", "--termination", "known", "--search", "width=1:2")
    check_refused(say("sweep", "LunarLanderContinuous-v3", *oracle), "--termination")
    assert list(Path.cwd().iterdir()) == []


def test_a_study_that_is_stopped_says_how_to_go_on(say: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def stopped(*arguments: Any, should_stop: Any, **others: Any) -> None:
        given.extend(arguments)
        should_stop.signal = 15

    monkeypatch.setattr("mbdpg.cli.reproduce.reproduce_study", stopped)
    said = say("reproduce", "figure-8", "--scale", "smoke", "--seeds", "3")
    assert said == Said(143, "", "mbdpg: saved; go on with: mbdpg reproduce figure-8 --scale smoke --seeds 3\n")
    assert given == ["figure-8", "smoke", Path.cwd() / "studies" / "smoke", Local()]


@pytest.mark.parametrize("seeds", [("1", "1"), ("0", "-1"), ()], ids=str)
def test_wrong_seeds_are_refused_before_an_expert_is_trained_for_them(say: Any, seeds: Any) -> None:
    """Only the first was looked at before it."""
    flags = ("--demonstrations", "expert", "--out", "x")
    check_refused(say("train", "LunarLanderContinuous-v3", *flags, "--seeds", *seeds), "--seeds are [")
    assert list(Path.cwd().iterdir()) == []


def test_an_expert_that_is_stopped_says_how_to_go_on_with_all_that_was_given(say: Any, monkeypatch: Any) -> None:
    """Flags that were given were not in what it said to type, nor the training that it was for."""

    def stopped(config: Any, *, seeds: Any, out: Path, should_stop: Any, **others: Any) -> list[Path]:
        should_stop.signal = 15
        return [out / f"seed-{seeds[0]}"]

    monkeypatch.setattr("mbdpg.cli.demonstrate.train", stopped)
    flags = "Ant-v5 --out good.safetensors --observation-size 27 --success-return 9 --seed 3"
    go_on = "mbdpg: saved; go on with: mbdpg resume"
    said = say("demonstrate", *flags.split())
    run = "good-expert/seed-3"
    assert said == Said(143, "", f"{go_on} {run}, then mbdpg demonstrate {flags} --expert {run}\n")
    said = say(
        "train", "Ant-v5", "--observation-size", "27", "--seeds", "4", "--demonstrations", "expert", "--out", "x"
    )
    run, file = "x/demonstrations-expert/seed-4", "x/demonstrations.safetensors"
    again = f"mbdpg demonstrate Ant-v5 --out {file} --seed 4 --observation-size 27 --expert {run}"
    assert said == Said(143, "", f"{go_on} {run}, then {again}, then this again with --demonstrations {file}\n")


def test_an_empty_run_folder_will_do_where_an_expert_comes_first(say: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was refused, but only with --demonstrations expert."""

    def made(*arguments: Any, **others: Any) -> None:
        raise UserError("here an expert is trained")

    monkeypatch.setattr("mbdpg.cli.train.make_demonstrations", made)
    Path("x/seed-0").mkdir(parents=True)
    check_refused(say("train", "Pendulum-v1", "--demonstrations", "expert", "--out", "x"), "here an expert is trained")


def test_what_training_would_refuse_is_refused_before_an_expert_is_trained_for_it(say: Any, trained: Path) -> None:
    """It was said after the 200,000 steps of the expert."""
    shutil.copytree(trained, "x/seed-0")
    Path("file").write_text("")
    expert = ("--demonstrations", "expert")
    check_refused(say("train", "Pendulum-v1", *expert, "--out", "x"), "x/seed-0 is not empty", "another --out")
    check_refused(say("train", "Pendulum-v1", *expert, "--out", "file"), "cannot create file/seed-0")
    oracle = ("--algorithm", "mbpo", "--termination", "known")
    check_refused(say("train", "LunarLanderContinuous-v3", *oracle, *expert, "--out", "y"), "--termination")
    check_refused(say("demonstrate", "LunarLanderContinuous-v3", "--out", "x"), "--out is x, a folder")
    assert [path.name for path in Path("x").iterdir()] == ["seed-0"] and not Path("y").exists()


def test_what_there_is_to_type_can_be_typed(say: Any, toys: None, monkeypatch: Any) -> None:
    """Folders with spaces were not quoted, and an id that names a module was refused without --allow-import."""
    said = say("train", "Pendulum-v1", *TINY, "--out", "my runs")
    assert "next: mbdpg evaluate 'my runs/seed-0' --episodes 10 --video 'my runs/policy.mp4'\n" in said.out

    def stopped(self: Any, update: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr("mbdpg.reports.console.RunDisplay.__call__", stopped)
    flags = (*TINY, "--allow-import", "--out", "own runs")
    said = say("train", "gymnasium:Pendulum-v1", *flags)
    assert said.err.endswith("go on with: mbdpg resume 'own runs' --allow-import\n")
    said = say("resume", "own runs", "--allow-import", "--steps", "60")
    assert said.err.endswith("go on with: mbdpg resume 'own runs' --allow-import --steps 60\n")


def test_an_expert_of_another_environment_is_refused(say: Any, trained: Path) -> None:
    said = say("demonstrate", "LunarLanderContinuous-v3", "--out", "good.safetensors", "--expert", trained)
    check_refused(said, "is for 3 observation and 1 action entries, but LunarLanderContinuous-v3 has 8 and 2")
    assert list(Path.cwd().iterdir()) == []


def test_an_expert_without_a_success_says_what_to_do(say: Any, trained: Path) -> None:
    flags = ("--expert", trained, "--episodes", "1", "--success-return", "0")
    check_refused(say("demonstrate", "Pendulum-v1", "--out", "good.safetensors", *flags), "--success-return")
    assert list(Path.cwd().iterdir()) == []


def test_every_verb_says_what_to_do_with_a_run_of_an_environment_made_in_code(say: Any, toys: None, toy: Any) -> None:
    class Balance(gymnasium.Env[Any, Any]):
        observation_space = gymnasium.spaces.Box(-1, 1, (2,))
        action_space = gymnasium.spaces.Box(-1, 1, (1,))

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
            return np.zeros(2, np.float32), {}

        def step(self, action: np.ndarray) -> Any:
            return np.zeros(2, np.float32), 0.0, False, False, {}

    def balance() -> gymnasium.Env[Any, Any]:
        return gymnasium.wrappers.TimeLimit(Balance(), 5)

    schedule = mbdpg.Schedule(steps=40, cycle=20, evaluate_every=40, log_every=40, checkpoint_every=40)
    config = mbdpg.TD3Config(width=3, random_steps=20)
    (folder,) = mbdpg.train(balance, config=config, schedule=schedule, out="run")
    check_refused(say("resume", folder), "environment made in code", "mbdpg.resume(..., env=...)")
    check_refused(say("evaluate", folder), "environment made in code", "mbdpg.evaluate")
    said = say("demonstrate", "Pendulum-v1", "--out", "good.safetensors", "--expert", folder)
    check_refused(said, "is for 2 observation and 1 action entries, but Pendulum-v1 has 3 and 1")
    assert RunFolder.open(folder).config["env"] == "balance"


def test_a_run_folder_never_decides_that_code_is_imported(say: Any, trained: Path, monkeypatch: Any) -> None:
    Path("hostile.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(".")
    shutil.copytree(trained, "run")
    config = json.loads(Path("run/config.json").read_text())
    config["run"] |= {"env": "hostile:Env-v0"}
    config["run"]["env_options"]["allow_import"] = True
    Path("run/config.json").write_text(json.dumps(config))
    for verb in ("resume", "evaluate"):
        check_refused(say(verb, "run"), "would run the code of the module hostile")
    assert "hostile" not in sys.modules


def test_the_last_of_two_algorithms_is_the_one_that_is_trained(say: Any, toys: None) -> None:
    said = say("train", "Pendulum-v1", "--algorithm", "mbdpg", *TINY, "--out", "run")
    assert said.status == 0, said.err
    assert RunFolder.open(Path("run/seed-0")).config["algorithm"] == "td3"


def test_report_compares_runs_in_tables_and_on_a_page(say: Any, toys: None) -> None:
    for seed in ("0", "1"):
        assert say("train", "Pendulum-v1", *TINY, "--seeds", seed, "--out", f"runs/{seed}").status == 0
    said = say("report", "runs", "--out", "new/page.html")
    assert said.status == 0, said.err
    lines = said.out.splitlines()
    assert lines[0] == "Pendulum-v1" and lines[1].startswith("return at 40 steps: ")
    assert lines[2].startswith("  td3 (2 runs): -")
    assert lines[3] == "page with curves, settings and more: new/page.html"
    assert Path("new/page.html").read_text().startswith("<!DOCTYPE html>")
    check_refused(say("report", "new"), "new is no run folder and has none in it")
    check_refused(
        say("report", "runs", "--at", "30"), "--at is 30, expected a step at which a run was evaluated: 0, 20, 40"
    )
    check_refused(say("report"), "expected run folders")


def test_a_stranger_s_run_does_not_write_control_characters_to_the_terminal(say: Any, toys: None) -> None:
    assert say("train", "Pendulum-v1", *TINY, "--out", "run").status == 0
    config = Path("run/seed-0/config.json")
    config.write_text(config.read_text().replace("Pendulum-v1", "Pendulum\\u001b[31m-v1"))
    said = say("report", "run")
    assert said.status == 0, said.err
    assert said.out.splitlines()[0] == r"Pendulum\x1b[31m-v1"


def test_a_damaged_run_is_left_out_of_the_report_and_named(say: Any, toys: None) -> None:
    """It kept the others from being shown."""
    for seed in ("0", "1"):
        assert say("train", "Pendulum-v1", *TINY, "--seeds", seed, "--out", f"runs/{seed}").status == 0
    Path("runs/0/seed-0/config.json").write_text("{")
    said = say("report", "runs", "--out", "page.html")
    assert said.status == 0, said.err
    lines = said.out.splitlines()
    assert lines[0].startswith("left out: ") and "runs/0/seed-0" in lines[0] and lines[3].startswith("  td3 (1 run): ")
    assert '"left_out"' in (page := Path("page.html").read_text()) and "runs/0/seed-0" in page
    check_refused(say("report", "runs/0"), "no run is left to report")
    Path("runs/1/seed-1/metrics.jsonl").write_text("")  # of a run that has just begun
    check_refused(say("report", "runs/1"), "no run is left to report")
    assert "left out: runs/1/seed-1 has no evaluation with a return yet" in say("report", "runs/1").out


def test_report_without_a_common_step_is_refused_but_for_its_page(say: Any, toys: None) -> None:
    for seed in ("0", "1"):
        assert say("train", "Pendulum-v1", *TINY, "--seeds", seed, "--out", f"runs/{seed}").status == 0
    metrics = Path("runs/0/seed-0/metrics.jsonl")
    late = [row for row in metrics.read_text().splitlines(keepends=True) if '"env_steps": 40' in row]
    metrics.write_text("".join(late))
    Path("runs/1/seed-1/metrics.jsonl").write_text(
        Path("runs/1/seed-1/metrics.jsonl").read_text().replace('"env_steps": 40', '"env_steps": 41')
    )
    check_refused(say("report", "runs"), "no evaluation at the same step")
    said = say("report", "runs", "--out", "page.html")
    assert said.status == 0 and "no evaluation at the same step" in said.out


def test_a_page_that_cannot_be_written_is_refused_before_anything_is_read(say: Any) -> None:
    Path("file").touch()
    Path("folder.html").mkdir()
    check_refused(
        say("report", "missing", "--out", "page.png"), "--out is page.png, expected a name that ends in .html"
    )
    check_refused(say("report", "missing", "--out", "folder.html"), "--out is folder.html, a folder")
    check_refused(say("report", "missing", "--out", "file/page.html"), "cannot write file/page.html")
    check_refused(say("report", "missing", "--out", f"{'x' * 300}.html"), "File name too long")


def test_a_run_that_ends_before_it_learns_says_so(say: Any, toys: None) -> None:
    said = say("train", "Pendulum-v1", *TINY, "--random-steps", "40", "--out", "run")
    assert said.status == 0
    assert said.err.startswith("mbdpg: nothing will be learned: all 40 --steps are --random-steps (40)\n")
    assert "nothing" not in say("train", "Pendulum-v1", *TINY, "--random-steps", "39", "--out", "other").err


def test_a_finished_run_is_said_to_be_so_on_resume(say: Any, trained: Path) -> None:
    said = say("resume", trained)
    assert said.status == 0 and f"{trained} has its 400 steps already; --steps makes it longer" in said.out


def test_runs_that_go_on_one_after_the_other_are_named_before_their_progress(say: Any, toys: None) -> None:
    """Which of a folder's runs a progress line was of, nobody knew."""
    say("train", "Pendulum-v1", *TINY, "--seeds", "0", "1", "--out", "run")
    assert "going on with" not in say("resume", "run", "--steps", "60").err  # both at once
    say("train", "Pendulum-v1", *TINY, "--seeds", "2", "--batch-size", "3", "--out", "run")
    said = say("resume", "run", "--steps", "80").err
    assert "going on with run/seed-0, run/seed-1\n" in said and "going on with run/seed-2\n" in said


def test_the_next_line_can_be_pasted_where_the_program_is_not_on_the_path(
    say: Any, toys: None, monkeypatch: Any
) -> None:
    monkeypatch.setattr(sys, "argv", [".venv/bin/mbdpg"])
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert "next: .venv/bin/mbdpg evaluate run/seed-0" in say("train", "Pendulum-v1", *TINY, "--out", "run").out
    monkeypatch.setattr(shutil, "which", lambda name: "/usr/bin/mbdpg")
    assert "next: mbdpg evaluate other/seed-0" in say("train", "Pendulum-v1", *TINY, "--out", "other").out


# Through the real program, once.


def test_debug_shows_the_traceback_and_without_it_there_is_none(mbdpg_command: Start, say: Any) -> None:
    program = mbdpg_command("evaluate", "missing", "--debug")
    _, stderr = program.communicate()
    assert program.returncode == 1
    assert "Traceback" in stderr and stderr.splitlines()[-1].startswith("mbdpg.interfaces.UserError: missing is not")
    said = "mbdpg: missing is not a folder; expected one that `mbdpg train --out` made\n"
    assert say("evaluate", "missing") == Said(1, "", said)


def test_training_does_not_wait_for_what_draws() -> None:
    """Every verb waited for Matplotlib, a fifth of all modules' time."""
    code = "import sys, mbdpg.cli.train, mbdpg.cli.evaluate; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_an_unexpected_error_is_one_line_too(say: Any, monkeypatch: Any) -> None:
    def fail(arguments: list[str]) -> None:
        raise RuntimeError("first\nsecond")

    monkeypatch.setattr("mbdpg.cli.train.train", fail)
    said = say("train", "Pendulum-v1")
    assert said == Said(1, "", "mbdpg: unexpected RuntimeError: first second; --debug shows where\n")
    with pytest.raises(RuntimeError):
        main(["train", "Pendulum-v1", "--debug"])


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("INTERNAL: Out of memory allocating 8e16 bytes.")])
def test_too_little_memory_is_said_with_the_flags_that_lower_it(say: Any, monkeypatch: Any, error: Exception) -> None:
    def fail(arguments: list[str]) -> None:
        raise error

    monkeypatch.setattr("mbdpg.cli.train.train", fail)
    check_refused(
        say("train", "Pendulum-v1"),
        "not enough memory",
        "lower its largest width, batch, count or horizon",
    )


def test_ctrl_c_where_there_is_nothing_to_save_is_no_traceback(say: Any, monkeypatch: Any) -> None:
    def interrupted(arguments: list[str]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mbdpg.cli.evaluate.evaluate", interrupted)
    assert say("evaluate", "run") == Said(130, "", "")
