"""Learning curves from run folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")  # no display is ever needed
from matplotlib import pyplot as plt  # noqa: E402 - the backend is chosen before

from mbdpg.interfaces import UserError  # noqa: E402
from mbdpg.storage.metrics import read_metrics  # noqa: E402


def draw_curves(groups: Mapping[str, Sequence[Path]], path: Path, *, title: str) -> None:
    """Draw mean evaluation return over environment steps: each run thin, and each group's mean bold.

    Args:
        groups: run folders by label; runs of a group differ in their seed.
        path: the picture, its kind by its ending.
        title: above it.

    Raises:
        UserError: no run has an evaluation yet, or the picture cannot be written.
    """
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    drawn = False
    for number, (label, runs) in enumerate(groups.items()):
        curves = [read_metrics(run, "eval") for run in runs]
        curves = [curve for curve in curves if curve["env_steps"]]
        if not curves:
            continue
        drawn = True
        for curve in curves:
            axes.plot(curve["env_steps"], curve["eval/return_mean"], color=f"C{number}", alpha=0.35, linewidth=1)
        shared = sorted(set.intersection(*(set(curve["env_steps"]) for curve in curves)))
        at = [dict(zip(curve["env_steps"], curve["eval/return_mean"], strict=True)) for curve in curves]
        mean = [np.mean([run[step] for run in at]) for step in shared]
        seeds = f"{len(curves)} seed{'s' * (len(curves) > 1)}"
        axes.plot(shared, mean, color=f"C{number}", linewidth=2, label=f"{label} ({seeds})")
    if not drawn:
        plt.close(figure)
        raise UserError("no run has an evaluation yet; train until the first one, then draw again")
    axes.set(xlabel="environment steps", ylabel="evaluation return", title=title)
    axes.grid(alpha=0.3)
    axes.legend()
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
    finally:
        plt.close(figure)
