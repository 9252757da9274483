"""What a study sets side by side: learning curves of a task, or errors of models; and where they come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mbdpg.reports.record import Record


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
    published_hours: Mapping[str, float] = field(default_factory=dict)
    """Of the paper's runs, by label."""

    def evaluations(self, *, gaps: bool = False) -> dict[str, list[dict[int, Evaluation]]]:
        """Of every run, by label; those in which every episode failed are left out or, as gaps, NaN."""
        return {label: [_evaluations(run, gaps=gaps) for run in runs] for label, runs in self.runs.items()}

    def origins(self) -> dict[Path, Mapping[str, Any]]:
        """What each run records of its commit and machine, by its folder."""
        return {run.folder: run.config for runs in self.runs.values() for run in runs}


@dataclass(frozen=True)
class Errors:
    """Open-loop errors of dynamics models."""

    title: str
    files: Mapping[str, Mapping[Path, Mapping[str, Any]]]
    """CSV files with depth, rmse and persistence, one per seed, each with its commit and machine; by label."""

    def tables(self) -> dict[str, np.ndarray]:
        """Shape (seed, depth, 3) by label."""
        return {
            label: np.stack([np.loadtxt(file, delimiter=",", skiprows=1) for file in files])
            for label, files in self.files.items()
        }

    def origins(self) -> dict[Path, Mapping[str, Any]]:
        """What is recorded of each file's commit and machine."""
        return {file: origin for files in self.files.values() for file, origin in files.items()}


Panels = Sequence[Curves | Errors]


def _evaluations(run: Record, *, gaps: bool) -> dict[int, Evaluation]:
    """A run's by environment steps."""
    hours, experts = run.hours(), dict(zip(run.steps, run.column("expert_env_steps"), strict=True))
    curve = run.curve_with_gaps if gaps else run.curve
    return {step: Evaluation(step, int(experts[step] or 0), mean, hours.get(step)) for step, mean in curve.items()}
