"""One run as reports need it. Its files may be anybody's: what is no finite number counts as missing."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mbdpg.interfaces import UserError, require
from mbdpg.storage.metrics import read_metrics
from mbdpg.storage.run_folder import RunFolder

Curve = Mapping[int, float]
"""Mean evaluation return by environment steps. Evaluations in which every episode failed are not in it, or, in a curve
with gaps, NaN: no line is to be drawn across them."""


class Record(NamedTuple):
    """What a run has recorded so far."""

    folder: Path
    name: str
    """What tells it from the other runs of a report."""
    config: dict[str, Any]
    evaluations: dict[str, list[Any]]
    """Rows of kind `eval` as columns, as `read_metrics` returns them."""
    training: dict[str, list[Any]]
    """Rows of kind `train`, likewise."""

    @classmethod
    def read(cls, folder: Path, *, root: Path) -> Record:
        """Read a run folder; it is called by its path from `root`.

        Raises:
            UserError: it is none, it has no rows yet, or one of its files is damaged.
        """
        config, name = RunFolder.open(folder).config, os.path.relpath(folder, root)
        return cls(folder, name, config, read_metrics(folder, "eval"), read_metrics(folder, "train"))

    @property
    def curve(self) -> Curve:
        return _curve(self.evaluations, gaps=False)

    @property
    def curve_with_gaps(self) -> Curve:
        return _curve(self.evaluations, gaps=True)

    @property
    def steps(self) -> list[int]:
        """Environment steps of the evaluations."""
        return self.evaluations["env_steps"]

    def column(self, name: str) -> list[float | None]:
        """A number per evaluation; None where it is missing or not finite."""
        return numbers(self.evaluations, name)

    def hours(self) -> dict[int, float]:
        """Hours of training by environment steps, wherever a row has them."""
        found: dict[int, float] = {}
        for columns in (self.evaluations, self.training):
            for step, seconds in zip(columns["env_steps"], numbers(columns, "time/seconds"), strict=True):
                if seconds is not None:  # of two rows of a step, the later one
                    found[step] = max(seconds / 3600, found.get(step, 0.0))
        return dict(sorted(found.items()))

    def problems(self) -> list[str]:
        """What did not go as planned, a phrase each."""
        found = []
        reached = max([0, *self.steps, *self.training["env_steps"]])
        planned = number(setting(self.config, "schedule").get("steps"))
        if planned is not None and reached < planned:
            found.append(f"reached {reached:,} of {planned:,.0f} planned steps")
        gone = sum(value is None for value in self.column("eval/return_mean"))
        if gone:
            found.append(f"{gone} of {len(self.steps)} evaluations have no return")
        if faults := sum(value or 0 for value in self.column("eval/faults")):
            found.append(f"{faults:,.0f} evaluation episodes left out because the environment failed")
        if faults := max((value or 0 for value in numbers(self.training, "train/faults")), default=0):
            found.append(f"{faults:,.0f} training episodes cut short because the environment failed")
        for name in sorted(name for name in self.training if name.endswith("/skipped")):
            # A mean over the interval of a count that only grows: the whole updates are at least so many.
            if skipped := max((value or 0 for value in numbers(self.training, name)), default=0):
                found.append(f"{math.ceil(skipped):,} or more {name.removesuffix('/skipped')} updates skipped")
        return found


def read_records(folders: Sequence[Path], *, leave_out: Callable[[str], None]) -> list[Record]:
    """Read runs, each called by its path from the folder that holds them all.

    Args:
        folders: of the runs.
        leave_out: called with what is wrong with each that cannot be read or has nothing to compare.
    """
    if not folders:
        return []
    root, found = Path(os.path.commonpath([folder.absolute().parent for folder in folders])), []
    for folder in folders:
        try:
            run = Record.read(folder, root=root)
            require(bool(run.curve), f"{folder} has no evaluation with a return yet")
        except UserError as error:
            leave_out(str(error))
        else:
            found.append(run)
    return found


def learning_curve(folder: Path, *, gaps: bool = False) -> Curve:
    """The curve of a run, whose config need not be there.

    Raises:
        UserError: it has no rows yet, or a damaged one.
    """
    return _curve(read_metrics(folder, "eval"), gaps=gaps)


def shared_steps(curves: Iterable[Mapping[int, Any]]) -> list[int]:
    """Environment steps that all have, in order."""
    steps = [set(curve) for curve in curves]
    return sorted(set.intersection(*steps)) if steps else []


def mean_curve(curves: Sequence[Curve]) -> Curve:
    """Their mean at the steps that all have."""
    return {step: float(np.mean([curve[step] for curve in curves])) for step in shared_steps(curves)}


def numbers(columns: Mapping[str, list[Any]], name: str) -> list[float | None]:
    """A column with None for whatever is no finite number; all None if there is no such column."""
    return [number(value) for value in columns.get(name, [None] * len(columns["env_steps"]))]


def number(value: object) -> float | None:
    """The value if it is a finite number whose square is one too, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e100:
        return None
    return float(value) if math.isfinite(value) else None


def setting(config: Mapping[str, Any], name: str) -> dict[str, Any]:
    """A group of settings, empty where the config has something else in its place."""
    value = config.get(name)
    return value if isinstance(value, dict) else {}


def text(value: object) -> str:
    """A setting as a person writes it: absent is a dash, and 1.0 is 1."""
    if isinstance(value, str):
        return value
    return "—" if value is None else json.dumps(_whole(value), sort_keys=True)


def _whole(value: Any) -> Any:
    """JSON whose numbers without a fraction are integers, so that what is equal looks equal."""
    if isinstance(value, list | tuple):
        return list(map(_whole, value))
    if isinstance(value, dict):
        return {str(name): _whole(own) for name, own in value.items()}
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _curve(evaluations: Mapping[str, list[Any]], *, gaps: bool) -> Curve:
    pairs = zip(evaluations["env_steps"], numbers(evaluations, "eval/return_mean"), strict=True)
    return {step: math.nan if value is None else value for step, value in pairs if gaps or value is not None}
