"""What is read of a run: its hours over restarts, and what did not go as planned."""

from collections.abc import Callable
from pathlib import Path

import pytest

from mbdpg.reports.record import Record, number

Make = Callable[..., Path]


def test_hours_go_on_after_a_resume(tmp_path: Path, make: Make) -> None:
    first = {0: {"time/seconds": 10.0, "time/acting": 0.0}, 100: {"time/seconds": 3600.0, "time/acting": 9.0}}
    # The second process was slow to begin: only what it spent on acting tells that it is another.
    second = {200: {"time/seconds": 4000.0, "time/acting": 2.0}, 300: {"time/seconds": 7200.0, "time/acting": 3.0}}
    training = {100: {"time/seconds": 3601.0, "time/acting": 9.0}}
    run = make(tmp_path / "a", dict.fromkeys((0, 100, 200, 300), 1.0), evaluations=first | second, training=training)
    hours = Record.read(run, root=tmp_path).hours()
    assert hours == pytest.approx({0: 10 / 3600, 100: 3601 / 3600, 200: 7601 / 3600, 300: 10801 / 3600})


def test_without_timings_there_are_no_hours(tmp_path: Path, make: Make) -> None:
    assert Record.read(make(tmp_path / "a", {0: 1.0}), root=tmp_path).hours() == {}


def test_what_did_not_go_as_planned_is_said(tmp_path: Path, make: Make) -> None:
    run = make(
        tmp_path / "a",
        {0: 1.0, 100: float("nan")},
        config={"schedule": {"steps": 5000}},
        evaluations={0: {"eval/faults": 1}, 100: {"eval/faults": 2}},
        training={50: {"train/faults": 1, "critic/skipped": 0.5}, 150: {"train/faults": 4, "critic/skipped": 2.2}},
    )
    assert Record.read(run, root=tmp_path).problems() == [
        "reached 150 of 5,000 planned steps",
        "1 of 2 evaluations have no return",
        "3 evaluation episodes left out because the environment failed",
        "4 training episodes cut short because the environment failed",
        "3 or more critic updates skipped",
    ]
    fine = make(tmp_path / "b", {0: 1.0, 100: 2.0}, config={"schedule": {"steps": 100}})
    assert Record.read(fine, root=tmp_path).problems() == []


@pytest.mark.parametrize("value", [True, None, "1", [1], {}, float("nan"), float("inf"), 10**400, -1e200])
def test_what_is_no_finite_number_is_missing(value: object) -> None:
    assert number(value) is None
