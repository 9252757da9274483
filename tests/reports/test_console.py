"""What a person sees of a run, on a terminal and in a log file."""

from __future__ import annotations

import io
import re
import sys
import time
from typing import Any, NamedTuple

import pytest

from mbdpg.reports import console
from mbdpg.reports.console import PLAIN_SECONDS, RunDisplay


class Evaluation(NamedTuple):
    returns: list[float]


class Update(NamedTuple):
    env_steps: int
    train_returns: list[float]
    evaluation: list[Evaluation] | None = None


class Clock:
    """`time.monotonic` under the test's control; the wall clock runs backwards meanwhile."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now)
        monkeypatch.setattr(time, "time", lambda: 2e9 - self.now)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    captured = capsys.readouterr()
    assert captured.out == ""
    return captured.err.splitlines()


def test_a_log_file_gets_plain_lines(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with RunDisplay(10_000) as display:
        clock.now += 10
        display(Update(1000, [-200.0, -100.0], [Evaluation([-90.0, -110.0]), Evaluation([-100.0])]))
    (line,) = lines(capsys)
    assert line == "step 1,000/10,000  episode return -150.0  evaluation -100.0  100.0 steps/s  1m30s left"


def test_plain_lines_come_at_evaluations_at_the_end_and_else_seldom(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = []
    with RunDisplay(1000) as display:
        for step in range(50, 1001, 50):
            clock.now += PLAIN_SECONDS / 6
            display(Update(step, [0.0], [Evaluation([1.0])] if step == 400 else None))
            shown += [step] * len(lines(capsys))
    assert shown == [50, 350, 400, 700, 1000]


def test_the_last_evaluation_stays_in_view(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with RunDisplay(1000) as display:
        display(Update(0, [float("nan")], [Evaluation([5.0])]))
        clock.now += 2 * PLAIN_SECONDS
        display(Update(500, [7.0]))
    first, second = lines(capsys)
    assert "episode return -  evaluation 5.0" in first
    assert "episode return 7.0  evaluation 5.0" in second


def test_an_evaluation_without_a_return_is_a_dash_and_no_warning(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    with RunDisplay(1000) as display:
        display(Update(0, [float("nan")], [Evaluation([])]))
    assert "evaluation -  " in lines(capsys)[0]


def test_before_any_time_has_passed_nothing_is_promised(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with RunDisplay(1000) as display:
        display(Update(0, [float("nan")], [Evaluation([5.0])]))
    assert lines(capsys)[0].endswith("0.0 steps/s  - left")


def test_a_resumed_run_is_timed_from_where_it_goes_on(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with RunDisplay(10_000, done=9000) as display:
        clock.now += 10
        display(Update(9500, [1.0], [Evaluation([1.0])]))
    assert lines(capsys)[0].endswith("50.0 steps/s  0m10s left")


def test_time_left_is_never_negative_though_the_wall_clock_is_set_back(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    with RunDisplay(300) as display:
        for step in range(0, 301, 100):
            clock.now += 60
            display(Update(step, [0.0]))
    found = [re.search(r"(\S+) steps/s  (\S+) left", line) for line in lines(capsys)]
    assert [match and match[2] for match in found] == ["-", "4m00s", "1m30s", "0m00s"]


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.0, "0m00s"), (59.9, "0m59s"), (61.0, "1m01s"), (3599.0, "59m59s"), (36_061.0, "10h01m")]
)
def test_durations(seconds: float, text: str) -> None:
    assert console._duration(seconds) == text


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_one_moving_line(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal: Any = Terminal()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "stderr", terminal)
    with RunDisplay(1000) as display:
        assert display._bar is not None
        display._bar.live.auto_refresh = False
        for step in range(0, 1001, 500):
            clock.now += 1
            display(Update(step, [3.0]))
        display._bar.refresh()
    text = terminal.getvalue()
    assert "step 1,000/1,000" in text and "episode return 3.0" in text
    assert text.count("\n") < 10


def test_an_error_ends_the_moving_line(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal: Any = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with pytest.raises(ZeroDivisionError), RunDisplay(1000) as display:
        raise ZeroDivisionError
    assert display._bar is not None and display._bar.finished is False
    assert not display._bar.live.is_started
