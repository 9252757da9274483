"""Run folders side by side: found, grouped by their settings, and compared at one step."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mbdpg.interfaces import UserError
from mbdpg.reports.comparison import check_step, compare, compare_last, grouped, run_folders, table
from mbdpg.reports.record import Record, read_records

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


def records(root: Path) -> dict[str, list[Record]]:
    """All runs in a folder, by the first letter of their name."""
    found: dict[str, list[Record]] = {}
    for run in read_records(run_folders([root]), leave_out=pytest.fail):
        found.setdefault(run.name[0], []).append(run)
    return found


def test_the_table_is_of_the_last_step_that_all_share(tmp_path: Path, make: Make) -> None:
    for i in range(2):
        make(tmp_path / f"a{i}", {0: 0.0, 50: 10.0 + i, 100: 20.0 + i, 150: 99.0})
    make(tmp_path / "b", {0: 0.0, 50: 10.5, 100: 20.5})
    both = records(tmp_path)
    rows, notes = compare(both)
    lines = table(rows)
    assert lines[0].startswith("return at 100 steps: ") and lines[0].endswith("how often a is better")
    assert lines[1] == "  a (2 runs): 20.5 ± 0.7, 20.5 [20.0, 21.0]"
    assert lines[2] == "  b (1 run): 20.5, 50%" and notes == []
    single = table(compare({"b": both["b"]}).rows)
    assert single == ["return at 100 steps: of one run", "  b (1 run): 20.5"]
    assert table(compare(both, at=50).rows)[1].startswith("  a (2 runs): 10.5")


def test_a_run_too_short_for_at_costs_the_others_nothing(tmp_path: Path, make: Make) -> None:
    """One of them, in whatever environment, refused the whole report."""
    for name, last in (("a0", 100), ("a1", 50), ("b", 50)):
        make(tmp_path / name, {0: 0.0, last: 1.0})
    groups = records(tmp_path)
    rows, notes = compare(groups, at=100)
    assert [(row.label, row.summary.seeds) for row in rows] == [("a", 1)]
    assert notes == ["not evaluated at 100 steps, so not compared: a1 (last at 50), b (last at 50)"]
    assert compare({"b": groups["b"]}, at=100) == ([], ["not evaluated at 100 steps, so not compared: b (last at 50)"])
    runs = [run for own in groups.values() for run in own]
    check_step(runs, 100)
    with pytest.raises(UserError, match="--at is 30, expected a step at which a run was evaluated: 0, 50, 100"):
        check_step(runs, 30)


def test_a_seed_that_counts_twice_is_named(tmp_path: Path, make: Make) -> None:
    for name, seed in (("a0", 0), ("a1", 1), ("a2", 0)):
        make(tmp_path / name, {0: 0.0, 100: 1.0}, config={"seed": seed})
    runs = [run for own in records(tmp_path).values() for run in own]
    (note,) = compare({"a": runs}).notes
    assert note == "seed 0 counts 2 times in a, which makes intervals too narrow: a0, a2"
    assert compare({"a": runs[:2]}).notes == []


def test_a_run_that_has_just_begun_is_named_where_it_pulls_the_comparison_down(tmp_path: Path, make: Make) -> None:
    make(tmp_path / "a", dict.fromkeys((0, 100, 1000), 1.0))
    make(tmp_path / "b", dict.fromkeys((0, 100), 1.0))
    make(tmp_path / "c", dict.fromkeys((0, 100, 200), 1.0))
    groups = records(tmp_path)
    (note,) = compare(groups).notes
    assert note.startswith("compared at 100 of 1,000 steps: no more have b; with --at STEPS ")
    assert compare({name: groups[name] for name in "bc"}).notes == []  # half of it is far enough
    make(tmp_path / "d", dict.fromkeys((0, 150, 300), 1.0))
    groups = records(tmp_path)
    (note,) = compare({name: groups[name] for name in "ad"}).notes
    assert note.startswith("compared at 0 of 1,000 steps: evaluations are at different steps")


def test_the_last_evaluations_may_be_at_different_steps(tmp_path: Path, make: Make) -> None:
    make(tmp_path / "a0", {0: 0.0, 50: 4.0})
    make(tmp_path / "a1", {0: 0.0, 100: 6.0, 150: None})
    (row,) = compare_last(records(tmp_path))
    assert row[:2] == ("a", (50, 100)) and row.summary.mean == 5.0 and row.beaten is None


def test_runs_without_a_common_step_are_not_compared(tmp_path: Path, make: Make) -> None:
    make(tmp_path / "a", {0: 1.0})
    make(tmp_path / "b", {0: None, 5: 1.0})
    rows, (note,) = compare(records(tmp_path))
    assert table(rows) == [] and "no evaluation at the same step" in note
