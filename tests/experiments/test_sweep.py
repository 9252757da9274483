"""Searching settings: what may be asked for, and trials that end exactly once whatever happens to them."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from mbdpg.agents import mbdpg, td3
from mbdpg.experiments import sweep as module
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.launch import Work, launch
from mbdpg.experiments.pool import Local
from mbdpg.experiments.search import Search
from mbdpg.experiments.sweep import Trial, sweep
from mbdpg.experiments.work import Training
from mbdpg.interfaces import UserError
from mbdpg.storage.metrics import read_metrics
from mbdpg.training.loop import Schedule

extras = pytest.mark.extras
SCHEDULE = Schedule(steps=40, cycle=10, evaluate_every=20, evaluation_episodes=1, log_every=20, checkpoint_every=20)
CONFIG = RunConfig("Pendulum-v1", td3.Config(width=4, batch_size=4, random_steps=20), SCHEDULE)
SEARCHES = [Search("batch_size", 2, 9), Search("target_noise", 0.1, 0.4)]


class Suggested:
    """Answers like one of Optuna's trials: with the upper end, or the last choice."""

    def suggest_int(self, name: str, low: int, high: int, *, log: bool) -> int:
        return high

    def suggest_float(self, name: str, low: float, high: float, *, log: bool) -> float:
        return high

    def suggest_categorical(self, name: str, choices: list[str]) -> str:
        return choices[-1]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("horizon=1:20", 20),
        ("--critic-learning-rate=1e-5:1e-3:log", 1e-3),
        ("gradient=full,eq19", "eq19"),
        ("first-value=0,1", 1),
        ("terminal_value=true,false", False),
        ("trace=0,0.5", 0.5),
    ],
)
def test_a_search_gives_values_of_the_settings_own_type(text: str, value: Any) -> None:
    found = Search.parse(text, mbdpg.Config()).suggest(Suggested(), mbdpg.Config())
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wings=1:2", "'wings' is no setting of the algorithm; one is "),
        ("horizn=1:2", "'horizn' is no setting of the algorithm; one is horizon"),
        ("=1:2", "'' is no setting of the algorithm"),
        ("horizon", "expected at least two, horizon=LOW:HIGH or horizon=A,B,C"),
        ("horizon=5", "expected at least two, horizon=LOW:HIGH or horizon=A,B,C"),
        ("horizon=1:inf", "expected a lower number before a higher one"),
        ("horizon=nan:5", "expected a lower number before a higher one"),
        ("horizon=0.4:5:log", "expected two whole numbers"),
        ("discount=0.9,nan", "expected finite numbers, not nan"),
        ("discount=0.9,0.90", "all different"),
        ("horizon=a:b", "expected numbers, horizon=LOW:HIGH"),
        ("discount=1:0.5", "expected a lower number before a higher one"),
        ("discount=0:1:log", "a logarithmic range begins above 0"),
        ("discount=0.9:1:exp", "expected :log or nothing after the range"),
        ("discount=0:inf", "expected a lower number before a higher one"),
        ("horizon=1.5,2", "expected whole numbers"),
        ("horizon=2.6:2.9", "expected two whole numbers, a lower one before a higher one"),
        ("terminal-value=true,true", "expected at least two, some of true, false, with commas between"),
        ("gradient=full", "expected at least two, some of full, eq19"),
        ("gradient=1:2", "expected some of full, eq19, with commas between"),
        ("gradient=full,half", "expected some of full, eq19, with commas between"),
        ("trace=low,high", "expected numbers"),
        ("terminal-value=yes,no", "expected some of true, false"),
    ],
)
def test_a_search_that_cannot_be_is_refused_before_anything_is_trained(text: str, said: str) -> None:
    with pytest.raises(UserError) as refused:
        Search.parse(text, mbdpg.Config())
    assert said in str(refused.value) and str(refused.value).startswith(f"--search {text}: ")


@pytest.fixture
def here(toy: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Work is done in this process, by toys."""

    def done(works: Sequence[Work], engine: Any, **others: Any) -> dict[str, str]:
        for work in works:
            if not work.finished():
                work(lambda: False)
        return {}

    monkeypatch.setattr(module, "launch", done)
    with toy.learned_by_toys():
        yield


def begin(out: Path, trials: int = 3, **others: Any) -> list[str]:
    said: list[str] = []
    searches = others.pop("searches", SEARCHES)
    defaults = {"trials": trials, "seeds": (0, 1), "prune": False, "out": out, "engine": Local(1), "say": said.append}
    sweep(CONFIG, searches, **(defaults | others))
    return said


def table(out: Path) -> list[dict[str, str]]:
    with open(out / "sweep.csv", newline="") as file:
        return list(csv.DictReader(file))


@extras
def test_a_sweep_goes_on_where_it_was_and_says_what_was_best(here: None, tmp_path: Path) -> None:
    said = begin(tmp_path)
    rows = table(tmp_path)
    assert [row["state"] for row in rows] == ["complete"] * 3
    assert all(2 <= int(row["batch_size"]) <= 9 and 0.1 <= float(row["target_noise"]) <= 0.4 for row in rows)
    best = max(rows, key=lambda row: float(row["score"]))
    assert f"--batch-size {best['batch_size']} --target-noise {best['target_noise']}" in " ".join(said)
    assert (tmp_path / "history.png").stat().st_size > 1000
    for number in range(3):
        for seed in (0, 1):
            assert read_metrics(tmp_path / f"trial-{number:03d}" / f"seed-{seed}", "eval")["env_steps"] == [0, 20, 40]
    begin(tmp_path, trials=4)
    assert table(tmp_path)[:3] == rows and len(table(tmp_path)) == 4
    with pytest.raises(UserError, match="is of another sweep"):
        begin(tmp_path, searches=SEARCHES[:1])


def test_a_score_leaves_out_the_evaluation_before_anything_was_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "returns", lambda training: {0: -1000.0, 20: 1.0, 40: 3.0})
    assert module.score(Training(CONFIG, (0,), Path("trial"))) == 2.0
    monkeypatch.setattr(module, "returns", lambda training: {0: -1000.0})
    assert math.isnan(module.score(Training(CONFIG, (0,), Path("trial"))))


@extras
def test_fewer_trials_than_before_of_which_none_was_completed_are_said_to_be_none(
    here: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`max` of nothing was an unexpected error."""
    monkeypatch.setattr(Search, "suggest", lambda self, trial, agent: -1 if trial.number == 0 else 3)
    begin(tmp_path, trials=2, searches=SEARCHES[:1])
    with pytest.raises(UserError, match="no trial was completed"):
        begin(tmp_path, trials=1, searches=SEARCHES[:1])


@extras
def test_a_journal_whose_last_line_was_torn_goes_on(here: None, tmp_path: Path) -> None:
    begin(tmp_path, trials=1)
    with open(tmp_path / module.JOURNAL, "ab") as file:
        file.write(b'{"op_code": 4, "worker')
    begin(tmp_path, trials=2)
    assert [row["state"] for row in table(tmp_path)] == ["complete"] * 2
    assert len(module.opened(tmp_path).trials) == 2


@extras
def test_a_trial_whose_note_is_damaged_is_not_told_twice(here: None, tmp_path: Path) -> None:
    begin(tmp_path, trials=3)
    rows = table(tmp_path)
    (tmp_path / "trial-001" / "trial.json").write_text('{"trial"')
    said = begin(tmp_path, trials=3)
    assert table(tmp_path) == rows and len(module.opened(tmp_path).trials) == 3
    assert said[0].startswith("3 of 3 trials completed")


@extras
def test_a_sweep_that_lost_its_journal_or_its_plan_says_so(here: None, tmp_path: Path) -> None:
    begin(tmp_path, trials=1)
    (tmp_path / module.JOURNAL).rename(tmp_path / "kept")
    with pytest.raises(UserError, match=r"has trials but no journal.log; put it back"):
        begin(tmp_path, trials=2)
    (tmp_path / "kept").rename(tmp_path / module.JOURNAL)
    (tmp_path / "sweep.json").write_text("{")
    with pytest.raises(UserError, match=r"of another sweep, or its sweep.json is damaged"):
        begin(tmp_path, trials=2)


@extras
def test_a_trial_that_was_stopped_goes_on_with_the_same_settings(here: None, tmp_path: Path) -> None:
    (tmp_path / "sweep").mkdir()
    trial = Trial(0, CONFIG, tuple(SEARCHES), (0,), False, tmp_path / "sweep")
    asked = iter(range(10**6))
    trial(lambda: next(asked) > 25)
    note = trial.note()
    assert note["state"] == "running" and not trial.finished()
    trial(lambda: False)
    assert trial.note() == note | {"state": "complete"}
    assert len(module.opened(trial.out).trials) == 1
    assert read_metrics(trial.folder / "seed-0", "eval")["env_steps"] == [0, 20, 40]


@extras
def test_a_trial_that_was_told_but_not_noted_is_not_told_again(here: None, tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / "sweep").mkdir()
    trial = Trial(0, CONFIG, tuple(SEARCHES), (0,), False, tmp_path / "sweep")
    write = Trial._write

    def dies(self: Trial, number: int, values: Any, state: Any) -> None:
        if state == "complete":
            raise KeyboardInterrupt
        write(self, number, values, state)

    monkeypatch.setattr(Trial, "_write", dies)
    with pytest.raises(KeyboardInterrupt):
        trial(lambda: False)
    monkeypatch.setattr(Trial, "_write", write)
    assert trial.note()["state"] == "running"
    trial(lambda: False)
    assert trial.note()["state"] == "complete" and len(module.opened(trial.out).trials) == 1


@extras
def test_bad_trials_are_given_up_and_impossible_ones_passed_over(
    here: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "returns", lambda training: {0: 0.0, 50: -float(training.out.name[-3:])})
    begin(tmp_path / "pruned", trials=6, prune=True)
    states = [row["state"] for row in table(tmp_path / "pruned")]
    assert states[:4] == ["complete"] * 4 and set(states[4:]) == {"pruned"}
    assert (tmp_path / "pruned" / "importance.png").stat().st_size > 1000
    monkeypatch.setattr(Search, "suggest", lambda self, trial, agent: -1 if trial.number == 0 else 3)
    begin(tmp_path / "impossible", trials=2, searches=SEARCHES[:1])
    assert [row["state"] for row in table(tmp_path / "impossible")] == ["failed", "complete"]


@extras
def test_without_a_completed_trial_there_is_nothing_to_say(here: None, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(Search, "suggest", lambda self, trial, agent: -1)
    with pytest.raises(UserError, match="no trial was completed, see .*logs"):
        begin(tmp_path, trials=1, searches=SEARCHES[:1])


@extras
@pytest.mark.timeout(300)
def test_workers_that_are_killed_leave_every_trial_done_once(kill_in_the_middle: Any, tmp_path: Path) -> None:
    schedule = Schedule(steps=1500, evaluate_every=500, evaluation_episodes=1, log_every=100, checkpoint_every=100)
    config = RunConfig(
        "Pendulum-v1", td3.Config(width=8, batch_size=8, random_steps=100, updates_per_step=0.1), schedule
    )
    works = [Trial(number, config, (Search("batch_size", 2, 9),), (0,), False, tmp_path) for number in range(3)]
    killed = kill_in_the_middle(works[0].folder / "seed-0", 300)
    said: list[str] = []
    assert launch(works, Local(2), logs=tmp_path / "logs", say=said.append) == {}
    assert killed and "trial 0: its process died (SIGKILL); going on where it was" in said
    assert [work.note()["state"] for work in works] == ["complete"] * 3
    assert len(module.opened(tmp_path).trials) == 3
    for work in works:
        assert read_metrics(work.folder / "seed-0", "eval")["env_steps"] == [0, 500, 1000, 1500]


def test_without_optuna_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(UserError, match=r"needs Optuna, which is not installed: pip install 'mbdpg\[sweep\]'"):
        begin(tmp_path)
