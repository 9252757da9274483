"""Run folders side by side: found, grouped by their settings, and compared at one step."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mbdpg.interfaces import UserError
from mbdpg.reports.comparison import compare, compare_last, grouped, run_folders, table
from mbdpg.reports.record import Curve, learning_curve, read_records

Make = Callable[..., Path]


def test_folders_are_found_wherever_they_lie_and_each_once(tmp_path: Path, make: Make) -> None:
    runs = [make(tmp_path / "a" / f"seed-{i}", {0: 1.0}) for i in range(2)]
    assert run_folders([tmp_path]) == runs == run_folders([runs[0], tmp_path / "a"])
    for nothing in (tmp_path / "missing", tmp_path / "a" / "seed-0" / "policy"):
        with pytest.raises(UserError, match="is no run folder and has none in it"):
            run_folders([nothing])


def test_runs_are_grouped_by_everything_but_their_seed_and_named_by_what_differs(tmp_path: Path, make: Make) -> None:
    same = [make(tmp_path / f"same-{i}", {0: 1.0}) for i in range(2)]
    wide = make(tmp_path / "wide", {0: 1.0}, width=16)
    sac = make(tmp_path / "sac", {0: 1.0}, algorithm="sac", width=99)
    other = make(tmp_path / "other", {0: 1.0}, env="F-v0")
    groups = grouped(read_records([*same, wide, sac, other], leave_out=pytest.fail))
    folders = {env: {label: [run.folder for run in runs] for label, runs in own.items()} for env, own in groups.items()}
    assert folders == {
        "E-v0": {"td3 width=8": same, "td3 width=16": [wide], "sac": [sac]},
        "F-v0": {"td3": [other]},
    }


@pytest.mark.parametrize(("one", "other"), [(1, 1.0), (None, None), ([2, {"a": 3.0}], [2.0, {"a": 3}]), ("8", 8)])
def test_no_run_is_lost_where_equal_settings_are_written_differently(
    tmp_path: Path, make: Make, one: Any, other: Any
) -> None:
    """Two groups had one label, and the first of them was not in the report."""
    same = [make(tmp_path / "a", {0: 1.0}, discount=one), make(tmp_path / "b", {0: 1.0}, discount=other)]
    absent = [make(tmp_path / "c", {0: 1.0}, momentum=None), make(tmp_path / "d", {0: 1.0})]
    groups = grouped(read_records([*same, *absent], leave_out=pytest.fail))["E-v0"]
    names = {label: [run.name for run in own] for label, own in groups.items()}
    assert list(names.values()) == [["a", "b"], ["c", "d"]] and list(names)[1] == "td3 discount=0.9"


def test_no_run_is_lost_where_two_labels_are_one(tmp_path: Path, make: Make) -> None:
    odd = [
        make(tmp_path / "a", {0: 1.0}, algorithm="a b=1", c=1),
        make(tmp_path / "b", {0: 1.0}, algorithm="a b=1", c=2),
    ]
    plain = [
        make(tmp_path / "c", {0: 1.0}, algorithm="a", b="1 c=1"),
        make(tmp_path / "d", {0: 1.0}, algorithm="a", b=2),
    ]
    groups = grouped(read_records([*odd, *plain], leave_out=pytest.fail))["E-v0"]
    assert sorted(run.name for own in groups.values() for run in own) == ["a", "b", "c", "d"]


def curves(groups: dict[str, list[Path]]) -> dict[str, list[Curve]]:
    return {label: [learning_curve(run) for run in runs] for label, runs in groups.items()}


def test_the_table_is_of_the_last_step_that_all_share(tmp_path: Path, make: Make) -> None:
    good = [make(tmp_path / f"good-{i}", {0: 0.0, 50: 10.0 + i, 100: 20.0 + i, 150: 99.0}) for i in range(2)]
    bad = [make(tmp_path / "bad", {0: 0.0, 50: 10.5, 100: 20.5})]
    both = curves({"good": good, "bad": bad})
    lines = table(compare(both))
    assert lines[0].startswith("return at 100 steps: ") and lines[0].endswith("how often good is better")
    assert lines[1] == "  good (2 runs): 20.5 ± 0.7, 20.5 [20.0, 21.0]"
    assert lines[2] == "  bad (1 run): 20.5, 50%"
    single = table(compare(curves({"bad": bad})))
    assert single == ["return at 100 steps: of one run", "  bad (1 run): 20.5"]
    assert table(compare(both, at=50))[1].startswith("  good (2 runs): 10.5")
    with pytest.raises(UserError, match="--at is 150, expected a step at which all were evaluated: 0, 50, 100"):
        compare(both, at=150)


def test_the_last_evaluations_may_be_at_different_steps(tmp_path: Path, make: Make) -> None:
    runs = [make(tmp_path / "a", {0: 0.0, 50: 4.0}), make(tmp_path / "b", {0: 0.0, 100: 6.0, 150: None})]
    (row,) = compare_last(curves({"td3": runs}))
    assert row[:2] == ("td3", (50, 100)) and row.summary.mean == 5.0 and row.beaten is None


def test_runs_without_a_common_step_are_refused(tmp_path: Path, make: Make) -> None:
    runs = {"a": [make(tmp_path / "a", {0: 1.0})], "b": [make(tmp_path / "b", {0: None, 5: 1.0})]}
    assert compare(curves(runs)) == compare(curves(runs), at=0) == []
    with pytest.raises(UserError, match="no evaluation at the same step"):
        table([])
