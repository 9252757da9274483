"""A study's figure and numbers: learning curves as the paper draws them and as few seeds deserve, and model errors."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence, Sized
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mbdpg.reports.panels import Curves, Errors, Panels
from mbdpg.reports.record import shared_steps
from mbdpg.reports.statistics import sample_std, summarize
from mbdpg.reports.tables import Groups, tables
from mbdpg.storage.files import replace_durably, replace_table

COLUMNS: tuple[Any, ...] = (
    *("panel", "label", "seed", "env_steps", "expert_env_steps", "return_mean", "hours"),
    *("depth", "rmse", "persistence"),
)


def write_figure(
    name: str, panels: Panels, out: Path, *, heading: Sequence[str] = (), as_hours: bool = False
) -> list[str]:
    """Write `name`.csv and `name`.md into `out`, and `name`.png unless the study is a table of hours.

    Args:
        name: of the study.
        panels: what it sets side by side.
        out: folder.
        heading: paragraphs above the tables.
        as_hours: whether the tables are of wall-clock time.

    Returns:
        Lines that say where they are, and the tables.
    """
    replace_table(out / f"{name}.csv", [COLUMNS, *(row for panel in panels for row in _rows(panel))])
    text = tables(panels, as_hours=as_hours)
    page = [f"# {name}", *heading, "\n".join(text)]
    replace_durably(out / f"{name}.md", ("\n\n".join(page) + "\n").encode())
    lines = [f"numbers in {out / f'{name}.csv'}", f"tables in {out / f'{name}.md'}"]
    if not as_hours:
        replace_durably(out / f"{name}.png", _picture(panels))
        lines.append(f"figure in {out / f'{name}.png'}")
    return [*lines, *text]


def _rows(panel: Curves | Errors) -> list[Sequence[Any]]:
    """Of the CSV file."""
    rows: list[Sequence[Any]] = []
    if isinstance(panel, Curves):
        for label, runs in panel.evaluations().items():
            for record, run in zip(panel.runs[label], runs, strict=True):
                seed = record.folder.name.removeprefix("seed-")
                rows += [(panel.title, label, seed, *one, *[""] * 3) for one in run.values()]
        return rows
    for label, table in panel.tables().items():
        for path, own in zip(panel.files[label], table, strict=True):
            seed = path.stem.removeprefix("seed-")
            rows += [(panel.title, label, seed, *[""] * 4, int(depth), *both) for depth, *both in own]
    return rows


def _seeds(runs: Sized) -> str:
    return f"{len(runs)} seed{'s' * (len(runs) != 1)}"


def _picture(panels: Panels) -> bytes:
    """A column per panel. Learning curves have a row as in the paper, one for few seeds, one that counts experts."""
    rows = 3 if any(isinstance(panel, Curves) for panel in panels) else 1
    figure = Figure(figsize=(5.0 * len(panels), 3.4 * rows), layout="constrained")
    grid = figure.subplots(rows, len(panels), squeeze=False)
    for column, panel in zip(grid.T, panels, strict=True):
        if isinstance(panel, Errors):
            _draw_errors(column[0], panel)
            for axes in column[1:]:
                axes.axis("off")
            continue
        groups = panel.evaluations(gaps=True)
        _draw_curves(column[0], groups, _mean_and_std)
        _draw_curves(column[1], groups, _interquartile)
        _draw_curves(column[2], groups, _mean_and_std, count_experts=True)
        column[0].set_title(panel.title)
        for axes, what in zip(column, ("mean, std", "interquartile mean, 95 %", "mean, std"), strict=True):
            axes.set(xlabel="environment steps", ylabel=f"return ({what})")
        column[2].set_xlabel("environment steps, with the expert's")
        if column[0].lines:
            column[0].legend(fontsize="small")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=90)
    return picture.getvalue()


def _draw_errors(axes: Any, panel: Errors) -> None:
    tables = panel.tables()
    axes.set(xlabel="open-loop steps", ylabel="error, observation standard deviations", title=panel.title)
    if not tables:
        return
    for number, (label, table) in enumerate(tables.items()):
        depth, errors = table[0, :, 0], table[:, :, 1]
        mean, std = errors.mean(axis=0), sample_std(errors)
        axes.plot(depth, mean, color=f"C{number}", label=f"{label} ({_seeds(table)})")
        low, high = mean - std, mean + std
        axes.fill_between(depth, low, high, color=f"C{number}", alpha=0.2, linewidth=0)
    for table in [*tables.values()][:1]:
        axes.plot(table[0, :, 0], table[:, :, 2].mean(axis=0), color="gray", linestyle=":", label="no change at all")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def _draw_curves(
    axes: Any,
    groups: Groups,
    band: Callable[[list[float]], tuple[float, float, float]],
    *,
    count_experts: bool = False,
) -> None:
    for number, (label, runs) in enumerate(groups.items()):
        shared = shared_steps(runs)
        returns = [[run[step].return_mean for run in runs] for step in shared]
        if not np.isfinite([own for step in returns for own in step]).any():
            continue
        added = max(one.expert_env_steps for run in runs for one in run.values()) if count_experts else 0
        # A gap for all of them where one failed.
        bands = [band(own) if np.isfinite(own).all() else (np.nan,) * 3 for own in returns]
        middle, low, high = np.transpose(bands)
        steps = np.asarray(shared) + added
        axes.plot(steps, middle, color=f"C{number}", label=f"{label} ({_seeds(runs)})")
        axes.fill_between(steps, low, high, color=f"C{number}", alpha=0.2, linewidth=0)
    axes.grid(alpha=0.3)


def _mean_and_std(returns: list[float]) -> tuple[float, float, float]:
    mean, std = float(np.mean(returns)), float(sample_std(np.asarray(returns)))
    return mean, mean - std, mean + std


def _interquartile(returns: list[float]) -> tuple[float, float, float]:
    found = summarize(returns)
    whole = found.seeds > 1
    middle = found.interquartile_mean
    return middle, found.low if whole else middle, found.high if whole else middle
