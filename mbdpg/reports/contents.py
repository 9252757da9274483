"""What the page shows, in plain values that JSON knows: numbers to draw, and tables of text."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mbdpg.reports.comparison import Row, cells, check_step, compare, compare_last, grouped
from mbdpg.reports.diagnostics import RETURN, diagnostics, series_of
from mbdpg.reports.differences import differences, machine
from mbdpg.reports.record import Record, number
from mbdpg.storage.files import DamagedFileError, read_checked

MAX_VIDEO_BYTES = 8 << 20
"""Larger videos are named, not embedded."""

Groups = Mapping[str, Sequence[Record]]
Content = dict[str, Any]
"""What `json.dumps` takes."""


class Environment(NamedTuple):
    """The runs of one environment, read and compared."""

    name: str
    groups: Groups
    rows: list[Row]
    """What the groups reached at the same step; empty if there is none."""
    notes: list[str]
    """What is missing in the rows, and why."""


def compared(runs: Sequence[Record], *, at: int | None) -> list[Environment]:
    """The environments of runs, and what was reached there.

    Args:
        runs: of any settings.
        at: environment steps, as for `compare`.

    Raises:
        UserError: `at` is no step at which any was evaluated.
    """
    check_step(runs, at)
    return [Environment(env, groups, *compare(groups, at=at)) for env, groups in grouped(runs).items()]


def contents(environments: Sequence[Environment], left_out: Sequence[str] = ()) -> Content:
    """Everything on the page; `left_out` says of runs that are not there why."""
    runs = [run for environment in environments for own in environment.groups.values() for run in own]
    missing = _table("Left out", ["why"], [[reason] for reason in left_out])
    return {"left_out": missing, "environments": [_environment(own) for own in environments], "videos": videos(runs)}


def videos(runs: Sequence[Record]) -> list[Content]:
    """The MP4 files in the runs' folders and in those around them, each once: what it is called, and its address.

    Where it is too large or unreadable, a `note` stands in place of the address.
    """
    folders = [folder for run in runs for folder in (run.folder.absolute(), run.folder.absolute().parent)]
    paths = dict.fromkeys(path for folder in folders for path in sorted(folder.glob("*.mp4")))
    root = Path(os.path.commonpath(folders)) if folders else Path()
    found = []
    for path in paths:
        video: Content = {"name": os.path.relpath(path, root)}
        try:
            if path.stat().st_size > MAX_VIDEO_BYTES:
                video["note"] = (
                    f"not embedded: {path.stat().st_size / 2**20:.1f} MiB, more than {MAX_VIDEO_BYTES >> 20}"
                )
            else:
                data = read_checked(path, limit=MAX_VIDEO_BYTES)
                video["source"] = "data:video/mp4;base64," + base64.b64encode(data).decode()
        except (DamagedFileError, OSError):
            video["note"] = "not embedded: it is no file that can be read (links are not followed)"
        found.append(video)
    return found


def _environment(environment: Environment) -> Content:
    groups, rows = environment.groups, environment.rows
    series = {run.name: series_of(run) for runs in groups.values() for run in runs}
    charts = [RETURN, *diagnostics(name for own in series.values() for name in own)]
    step = rows[0].steps[1] if rows else None
    return {
        "name": environment.name,
        "groups": [
            {"label": label, "runs": [_run(run, series[run.name]) for run in runs]} for label, runs in groups.items()
        ],
        "charts": [chart._asdict() | {"lines": [line._asdict() for line in chart.lines]} for chart in charts],
        "notes": environment.notes,
        "scores": _scores(rows, compare_last(groups)),
        "clock": _clock(groups, step),
        "problems": _table(
            "Did not go as planned",
            ["group", "run", "what"],
            [[label, run.name, what] for label, runs in groups.items() for run in runs for what in run.problems()],
        ),
        "settings": _settings(groups),
    }


def _run(run: Record, series: Mapping[str, Sequence[float | None]]) -> Content:
    """A run's curves, with what may be the horizontal axis."""
    steps: list[float | None] = [number(step) for step in run.steps]
    expert = [
        None if own is None or more is None else own + more
        for own, more in zip(steps, run.column("expert_env_steps"), strict=True)
    ]
    hours = run.hours()
    axes = {"steps": steps, "expert": expert, "hours": [hours.get(step) for step in run.steps]}
    return {
        "name": run.name,
        "axes": {name: _rounded(values) for name, values in axes.items()},
        "series": {name: _rounded(values) for name, values in series.items()},
    }


def _rounded(values: Sequence[float | None]) -> list[float | None]:
    """To eight digits: more than a picture shows, less than a file is worth."""
    return [None if value is None else float(f"{value:.8g}") for value in values]


def _scores(rows: Sequence[Row], last: Sequence[Row]) -> list[Content]:
    """What was reached at the same step, and by the last evaluations; one table if that is the same."""
    title = f"Return at {rows[0].steps[1]:,} steps" if rows else ""
    if rows == last:
        return [_score_table(f"{title}, the last evaluation of every run", rows)] if rows else []
    end = _score_table("Return at the last evaluation of each run", last, steps=True)
    return [*([_score_table(title, rows)] if rows else []), end]


def _score_table(title: str, rows: Sequence[Row], *, steps: bool = False) -> Content:
    """A line per group; with the steps of its scores if the title does not say them."""
    header = ["group", *(["steps"] * steps), "runs", "mean", "± std", "interquartile mean", "95 % interval"]
    header += ["how often the best is better"] * (len(rows) > 1)
    lines = []
    for row in rows:
        low, high = row.steps
        line = [row.label, *([f"{low:,}" if low == high else f"{low:,} – {high:,}"] * steps)]
        line += [str(row.summary.seeds), *cells(row.summary)]
        line += ["" if row.beaten is None else f"{row.beaten:.0%}"] * (len(rows) > 1)
        lines.append(line)
    return _table(title, header, lines, numeric=range(1, len(header)))


def _clock(groups: Groups, step: int | None) -> Content:
    """Hours to a step and in all, means over the runs that have them; as a ratio too, if there is one group of TD3."""
    there: dict[str, float | None] = {}
    whole: dict[str, float | None] = {}
    for label, runs in groups.items():
        hours = [run.hours() for run in runs]
        there[label] = _mean([own[step] for own in hours if step in own])
        whole[label] = _mean([max(own.values()) for own in hours if own])
    rivals = [label for label, runs in groups.items() if runs[0].config.get("algorithm") == "td3"]
    unit = there[rivals[0]] if len(rivals) == 1 else None
    lines = []
    for label, runs in groups.items():
        machines = " / ".join(dict.fromkeys(machine(run.config) for run in runs))
        own = there[label]
        ratio = "" if own is None or not unit else f"{own / unit:.2f}"
        lines.append([label, _hours(own), ratio, _hours(whole[label]), machines])
    title = "Wall-clock hours, mean per run"
    header = ["group", "to the end" if step is None else f"to {step:,} steps", "÷ td3", "in all", "machine"]
    return _table(title, header, lines if any(whole.values()) else [], numeric=(1, 2, 3))


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _hours(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _settings(groups: Groups) -> list[Content]:
    """A table of what groups and runs set differently, and one of what only some algorithms have."""
    found = differences(groups)
    titles = {False: "Settings that differ", True: "Settings that only some algorithms have"}
    return [
        _table(title, ["setting", *groups], [[one.name, *one.cells] for one in found if one.own == own])
        for own, title in titles.items()
    ]


def _table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], *, numeric: Sequence[int] = ()) -> Content:
    """Text in rows and columns; the numeric ones are aligned on the right."""
    return {"title": title, "header": list(header), "rows": [list(row) for row in rows], "numeric": list(numeric)}
