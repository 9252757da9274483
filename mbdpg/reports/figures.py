"""A study's figure and numbers: learning curves as the paper draws them and as few seeds deserve, and model errors."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np

matplotlib.use("Agg")  # no display is ever needed
from matplotlib import pyplot as plt

from mbdpg.reports.record import Record
from mbdpg.reports.statistics import summarize
from mbdpg.storage.files import replace_durably, replace_table

COLUMNS: tuple[Any, ...] = (
    *("panel", "label", "seed", "env_steps", "expert_env_steps", "return_mean", "hours"),
    *("depth", "rmse", "persistence"),
)

DEPTHS = (1, 10, 50, 200)
"""Imagined steps whose error is printed."""


class Evaluation(NamedTuple):
    """One evaluation of one run."""

    env_steps: int
    expert_env_steps: int
    return_mean: float
    hours: float | None
    """Of wall-clock time so far, in every process that worked on the run; None where its timings are missing."""


@dataclass(frozen=True)
class Curves:
    """Learning curves of a task."""

    title: str
    runs: Mapping[str, Sequence[Record]]
    """By label."""

    def evaluations(self) -> dict[str, list[list[Evaluation]]]:
        """Of every run, by label."""
        return {label: [evaluations(run) for run in runs] for label, runs in self.runs.items()}


@dataclass(frozen=True)
class Errors:
    """Open-loop errors of dynamics models."""

    title: str
    files: Mapping[str, Sequence[Path]]
    """CSV files with depth, rmse and persistence, one per seed, by label."""

    def tables(self) -> dict[str, np.ndarray]:
        """Shape (seed, depth, 3) by label."""
        return {
            label: np.stack([np.loadtxt(file, delimiter=",", skiprows=1) for file in files])
            for label, files in self.files.items()
        }


def evaluations(run: Record) -> list[Evaluation]:
    """A run's evaluations but those in which every episode failed."""
    hours, experts = run.hours(), dict(zip(run.steps, run.column("expert_env_steps"), strict=True))
    return [Evaluation(step, int(experts[step] or 0), mean, hours.get(step)) for step, mean in run.curve.items()]


def write_figure(name: str, panels: Sequence[Curves | Errors], out: Path, *, as_hours: bool = False) -> list[str]:
    """Write `name`.csv into `out`, and `name`.png unless the study is a table of hours.

    Returns:
        Lines that say what is in them.
    """
    rows, lines = [COLUMNS], [f"numbers in {out / f'{name}.csv'}"]
    for panel in panels:
        if isinstance(panel, Curves):
            groups = panel.evaluations()
            for label, runs in groups.items():
                for record, run in zip(panel.runs[label], runs, strict=True):
                    seed = record.folder.name.removeprefix("seed-")
                    rows += [(panel.title, label, seed, *one, *[""] * 3) for one in run]
            lines += [panel.title, *(_hours(groups) if as_hours else _returns(groups))]
        else:
            lines += [f"{panel.title}: error after {', '.join(map(str, DEPTHS))} steps, persistence's last"]
            for label, table in panel.tables().items():
                for path, own in zip(panel.files[label], table, strict=True):
                    seed = path.stem.removeprefix("seed-")
                    rows += [(panel.title, label, seed, *[""] * 4, int(depth), *both) for depth, *both in own]
                lines.append(f"  {label} ({_seeds(table)}): {_errors(table)}")
    replace_table(out / f"{name}.csv", rows)
    if not as_hours:
        replace_durably(out / f"{name}.png", _picture(panels))
        lines.insert(1, f"figure in {out / f'{name}.png'}")
    return lines


def _errors(table: np.ndarray) -> str:
    mean, spread = table[:, :, 1].mean(axis=0), table[:, :, 1].std(axis=0, ddof=1 if len(table) > 1 else 0)
    parts = [f"{mean[depth - 1]:.3f} ± {spread[depth - 1]:.3f}" for depth in DEPTHS if depth <= table.shape[1]]
    return " / ".join([*parts, f"{table[:, -1, 2].mean():.3f}"])


def _returns(groups: Mapping[str, list[list[Evaluation]]]) -> list[str]:
    """Each group at the last step that all its runs have."""
    lines = []
    for label, runs in groups.items():
        shared = _shared(runs)
        if shared:
            found = summarize([_at(run, shared[-1]).return_mean for run in runs])
            interval = f", interquartile mean [{found.low:,.1f}, {found.high:,.1f}]" if found.seeds > 1 else ""
            spread = f" ± {found.std:,.1f}" if found.seeds > 1 else ""
            lines.append(f"  {label} ({_seeds(runs)}) at {shared[-1]:,}: {found.mean:,.1f}{spread}{interval}")
    return lines


def _hours(groups: Mapping[str, list[list[Evaluation]]]) -> list[str]:
    """Each group's wall-clock time at the last step that all runs of all groups have, and as a multiple of TD3's."""
    shared = _shared([run for runs in groups.values() for run in runs])
    if not shared:
        return ["  no step that all runs were evaluated at yet"]
    hours = {label: _mean([_at(run, shared[-1]).hours for run in runs]) for label, runs in groups.items()}
    unit = hours.get("td3")
    lines = []
    for label, found in hours.items():
        times = f" ({found / unit:.1f} times td3's)" if unit and found is not None else ""
        lines.append(
            f"  {label}: " + ("no timings" if found is None else f"{found:.2f} hours for {shared[-1]:,} steps{times}")
        )
    return lines


def _mean(values: Sequence[float | None]) -> float | None:
    """Of those that are there."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _seeds(runs: Sized) -> str:
    return f"{len(runs)} seed{'s' * (len(runs) != 1)}"


def _shared(runs: Sequence[Sequence[Evaluation]]) -> list[int]:
    return sorted(set.intersection(*({one.env_steps for one in run} for run in runs))) if runs else []


def _at(run: Sequence[Evaluation], step: int) -> Evaluation:
    return next(one for one in run if one.env_steps == step)


def _picture(panels: Sequence[Curves | Errors]) -> bytes:
    """A column per panel. Learning curves have a row as in the paper, one for few seeds, one that counts experts."""
    rows = 3 if any(isinstance(panel, Curves) for panel in panels) else 1
    size = (5.0 * len(panels), 3.4 * rows)
    figure, grid = plt.subplots(rows, len(panels), figsize=size, squeeze=False, layout="constrained")
    for column, panel in zip(grid.T, panels, strict=True):
        if isinstance(panel, Errors):
            _draw_errors(column[0], panel)
            for axes in column[1:]:
                axes.axis("off")
            continue
        groups = panel.evaluations()
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
    plt.close(figure)
    return picture.getvalue()


def _draw_errors(axes: Any, panel: Errors) -> None:
    tables = panel.tables()
    for number, (label, table) in enumerate(tables.items()):
        depth, errors = table[0, :, 0], table[:, :, 1]
        axes.plot(depth, errors.mean(axis=0), color=f"C{number}", label=f"{label} ({_seeds(table)})")
        mean, spread = errors.mean(axis=0), errors.std(axis=0, ddof=1) if len(errors) > 1 else 0.0
        low, high = mean - spread, mean + spread
        axes.fill_between(depth, low, high, color=f"C{number}", alpha=0.2, linewidth=0)
    for table in [*tables.values()][:1]:
        axes.plot(table[0, :, 0], table[:, :, 2].mean(axis=0), color="gray", linestyle=":", label="no change at all")
    axes.set(xlabel="open-loop steps", ylabel="error, observation standard deviations", title=panel.title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def _draw_curves(
    axes: Any,
    groups: Mapping[str, list[list[Evaluation]]],
    band: Callable[[list[float]], tuple[float, float, float]],
    *,
    count_experts: bool = False,
) -> None:
    for number, (label, runs) in enumerate(groups.items()):
        shared = _shared(runs)
        if not shared:
            continue
        added = max(one.expert_env_steps for run in runs for one in run) if count_experts else 0
        middle, low, high = np.transpose([band([_at(run, step).return_mean for run in runs]) for step in shared])
        steps = np.asarray(shared) + added
        axes.plot(steps, middle, color=f"C{number}", label=f"{label} ({_seeds(runs)})")
        axes.fill_between(steps, low, high, color=f"C{number}", alpha=0.2, linewidth=0)
    axes.grid(alpha=0.3)


def _mean_and_std(returns: list[float]) -> tuple[float, float, float]:
    mean, spread = float(np.mean(returns)), float(np.std(returns, ddof=1)) if len(returns) > 1 else 0.0
    return mean, mean - spread, mean + spread


def _interquartile(returns: list[float]) -> tuple[float, float, float]:
    found = summarize(returns)
    whole = found.seeds > 1
    middle = found.interquartile_mean
    return middle, found.low if whole else middle, found.high if whole else middle
