"""A study's tables as Markdown: what each group reached, in how many hours, and at which commits, on which machines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from mbdpg.reports.comparison import cells
from mbdpg.reports.differences import commit, machine
from mbdpg.reports.panels import Curves, Errors, Evaluation, Panels
from mbdpg.reports.record import shared_steps
from mbdpg.reports.statistics import sample_std, summarize

DEPTHS = (1, 10, 50, 200)
"""Imagined steps whose error is shown."""

Table = list[list[str]]
"""Rows of text, the first of them the names of the columns."""

Groups = Mapping[str, Sequence[Mapping[int, Evaluation]]]


def tables(panels: Panels, *, as_hours: bool) -> list[str]:
    """Lines of Markdown: a table per panel, of hours instead of returns if that is asked for, then their origins."""
    lines = []
    for panel in panels:
        if isinstance(panel, Errors):
            table = _errors(panel)
        else:
            table = _hours(panel) if as_hours else _returns(panel.evaluations())
        lines += [f"## {panel.title}", "", *(_markdown(table) if len(table) > 1 else ["Nothing to compare yet."]), ""]
    return [*lines, *_origins(panels)]


def _returns(groups: Groups) -> Table:
    """Each group at the last step that all its runs have."""
    table = [["", "seeds", "steps", "return", "std", "interquartile mean", "95 % interval", "hours"]]
    for label, runs in groups.items():
        if shared := shared_steps(runs):
            last = [run[shared[-1]] for run in runs]
            reached = cells(summarize([one.return_mean for one in last]))
            table.append([label, str(len(runs)), f"{shared[-1]:,}", *reached, _hours_of(last)])
    return table


def _hours(panel: Curves) -> Table:
    """Each group's wall-clock time at the last step that all runs of all groups have, and as a multiple of TD3's."""
    groups, published = panel.evaluations(), panel.published_hours
    shared = shared_steps(run for runs in groups.values() for run in runs)
    table = [
        ["", "seeds", "steps", "hours", "÷ td3", *(["paper's hours", "paper's ÷ td3"] * bool(published)), "machine"]
    ]
    last = {label: [run[shared[-1]] for run in runs] for label, runs in groups.items() if shared}
    hours = {label: _mean_hours(reached) for label, reached in last.items()}
    for label, reached in last.items():
        ratio = _ratio(hours[label], hours.get("td3"))
        row = [label, str(len(reached)), f"{shared[-1]:,}", _hours_of(reached), ratio]
        if published:
            row += [_number(published.get(label), 1), _ratio(published.get(label), published.get("td3"))]
        machines = dict.fromkeys(machine(run.config) for run in panel.runs[label])
        table.append([*row, " / ".join(machines)])
    return table


def _errors(panel: Errors) -> Table:
    """Each model's errors, and persistence's."""
    found = panel.tables()
    depths = [depth for depth in DEPTHS if all(depth <= errors.shape[1] for errors in found.values())]
    table = [["error (standard deviations) after", "seeds", *(f"{depth} step{'s' * (depth > 1)}" for depth in depths)]]
    for label, errors in found.items():
        mean, std = errors[:, :, 1].mean(axis=0), sample_std(errors[:, :, 1])
        parts = [f"{mean[i - 1]:.3f}" + f" ± {std[i - 1]:.3f}" * (len(errors) > 1) for i in depths]
        table.append([label, str(len(errors)), *parts])
    for errors in [*found.values()][:1]:  # the same for all, on the same steps
        table.append(["no change at all", "", *(f"{errors[:, i - 1, 2].mean():.3f}" for i in depths)])
    return table


def _origins(panels: Panels) -> list[str]:
    """How many runs and models record which commit and machine; one that several panels share counts once."""
    origins = {path: origin for panel in panels for path, origin in panel.origins().items()}
    counts = Counter((commit(origin), machine(origin)) for origin in origins.values())
    lines = [f"- {count} of {len(origins)}: commit {code}, on {where}" for (code, where), count in counts.items()]
    return ["Runs and models by what they record of their origin:", "", *lines] if lines else []


def _markdown(table: Table) -> list[str]:
    """The table, with columns that also stand below each other in a terminal."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    head, *rows = (" | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in table)
    rule = "-|-".join("-" * width for width in widths)
    return [f"| {head} |", f"|-{rule}-|", *(f"| {row} |" for row in rows)]


def _mean_hours(reached: Sequence[Evaluation]) -> float | None:
    """Over the runs that have timings."""
    known = [one.hours for one in reached if one.hours is not None]
    return float(np.mean(known)) if known else None


def _hours_of(reached: Sequence[Evaluation]) -> str:
    """Their mean hours, and of how many of them where some have no timings."""
    found, known = _number(_mean_hours(reached), 2), sum(one.hours is not None for one in reached)
    return f"{found} ({known} of {len(reached)})" if 0 < known < len(reached) else found


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:,.{digits}f}"


def _ratio(value: float | None, unit: float | None) -> str:
    return "" if value is None or not unit else f"{value / unit:.1f}"
