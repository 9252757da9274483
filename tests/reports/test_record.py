"""What is read of a run: its hours, and what did not go as planned."""

from collections.abc import Callable
from pathlib import Path

import pytest

from mbdpg.reports.record import Record, number

Make = Callable[..., Path]


def test_hours_are_those_of_the_later_row_of_a_step(tmp_path: Path, make: Make) -> None:
    evaluations = {0: {"time/seconds": 10.0}, 100: {"time/seconds": 3600.0}}
    training = {50: {"time/seconds": 1800.0}, 100: {"time/seconds": 3601.0}}
    run = make(tmp_path / "a", dict.fromkeys((0, 100), 1.0), evaluations=evaluations, training=training)
    hours = Record.read(run, root=tmp_path).hours()
    assert hours == pytest.approx({0: 10 / 3600, 50: 0.5, 100: 3601 / 3600}) and list(hours) == [0, 50, 100]


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
