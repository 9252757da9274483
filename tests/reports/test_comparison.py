"""Run folders side by side: found, grouped by their settings, and compared at one step."""

from pathlib import Path
from typing import Any

import pytest

from mbdpg.interfaces import UserError
from mbdpg.reports.comparison import grouped, run_folders, table
from mbdpg.storage.metrics import MetricsLog
from mbdpg.storage.run_folder import RunFolder


def make(
    path: Path, returns: dict[int, float | None], *, algorithm: str = "td3", env: str = "E-v0", **agent: Any
) -> Path:
    """A run folder with these evaluations."""
    config = {"env": env, "algorithm": algorithm, "agent": {"width": 8, "discount": 0.9} | agent, "env_options": {}}
    RunFolder.create(path, config | {"demonstrations": None, "seed": 0})
    log = MetricsLog(path)
    for step, value in returns.items():
        log.write("eval", step, {} if value is None else {"eval/return_mean": value})
    log.close()
    return path


def test_folders_are_found_wherever_they_lie_and_each_once(tmp_path: Path) -> None:
    runs = [make(tmp_path / "a" / f"seed-{i}", {0: 1.0}) for i in range(2)]
    assert run_folders([tmp_path]) == runs == run_folders([runs[0], tmp_path / "a"])
    for nothing in (tmp_path / "missing", tmp_path / "a" / "seed-0" / "policy"):
        with pytest.raises(UserError, match="is no run folder and has none in it"):
            run_folders([nothing])


def test_runs_are_grouped_by_everything_but_their_seed_and_named_by_what_differs(tmp_path: Path) -> None:
    same = [make(tmp_path / f"same-{i}", {0: 1.0}) for i in range(2)]
    wide = make(tmp_path / "wide", {0: 1.0}, width=16)
    sac = make(tmp_path / "sac", {0: 1.0}, algorithm="sac", width=99)
    other = make(tmp_path / "other", {0: 1.0}, env="F-v0")
    assert grouped([*same, wide, sac, other]) == {
        "E-v0": {"td3 width=8": same, "td3 width=16": [wide], "sac": [sac]},
        "F-v0": {"td3": [other]},
    }


def test_the_table_is_of_the_last_step_that_all_share(tmp_path: Path) -> None:
    good = [make(tmp_path / f"good-{i}", {0: 0.0, 50: 10.0 + i, 100: 20.0 + i, 150: 99.0}) for i in range(2)]
    bad = [make(tmp_path / "bad", {0: 0.0, 50: 10.5, 100: 20.5})]
    lines = table({"good": good, "bad": bad})
    assert lines[0].startswith("return at 100 steps: ") and lines[0].endswith("how often good is better")
    assert lines[1] == "  good (2 runs): 20.5 ± 0.7, 20.5 [20.0, 21.0]"
    assert lines[2] == "  bad (1 run): 20.5, 50%"
    assert table({"good": good, "bad": bad}, at=50)[1].startswith("  good (2 runs): 10.5")
    with pytest.raises(UserError, match="--at is 150, expected a step at which all were evaluated: 0, 50, 100"):
        table({"good": good, "bad": bad}, at=150)


def test_runs_without_a_common_step_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no evaluation at the same step"):
        table({"a": [make(tmp_path / "a", {0: 1.0})], "b": [make(tmp_path / "b", {0: None, 5: 1.0})]})
