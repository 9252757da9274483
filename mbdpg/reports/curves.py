"""Learning curves from run folders."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from mbdpg.interfaces import UserError
from mbdpg.reports.record import Curve, learning_curve, mean_curve
from mbdpg.storage.files import replace_durably


def draw_curves(groups: Mapping[str, Sequence[Path]], path: Path, *, title: str) -> None:
    """Draw mean evaluation return over environment steps: each run thin, each group's mean bold, failures as gaps.

    Args:
        groups: run folders by label; runs of a group differ in their seed.
        path: the picture, its kind by its ending.
        title: above it.

    Raises:
        UserError: no run has an evaluation yet, or the picture cannot be written.
    """
    curves_of = {label: [learning_curve(run, gaps=True) for run in runs] for label, runs in groups.items()}
    known = {
        label: [own for own in curves if any(map(math.isfinite, own.values()))] for label, curves in curves_of.items()
    }
    if not any(known.values()):
        raise UserError("no run has an evaluation yet; train until the first one, then draw again")
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    for number, (label, curves) in enumerate(known.items()):
        if not curves:
            continue
        draw_seeds(axes, curves, label=label, color=f"C{number}")
    axes.set(xlabel="environment steps", ylabel="evaluation return", title=title)
    axes.grid(alpha=0.3)
    axes.legend()
    picture = io.BytesIO()
    figure.savefig(picture, format=path.suffix[1:], dpi=130)
    try:
        replace_durably(path, picture.getvalue())  # and not what a link there points to
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def draw_seeds(axes: Any, curves: Sequence[Curve], *, label: str, color: str) -> None:
    """Draw each seed's curve thin and their mean bold, with how many there are in its label."""
    for curve in curves:
        axes.plot(list(curve), list(curve.values()), color=color, alpha=0.35, linewidth=1)
    mean, seeds = mean_curve(curves), f"{len(curves)} seed{'s' * (len(curves) > 1)}"
    axes.plot(list(mean), list(mean.values()), color=color, linewidth=2, label=f"{label} ({seeds})")
