"""Honest summaries of few runs that differ by their seed, after Agarwal et al. 2021 (rliable)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

RESAMPLES = 10_000
"""Draws of the bootstrap."""


class Summary(NamedTuple):
    """What the scores of some seeds say together."""

    seeds: int
    mean: float
    std: float
    """Of the sample, n - 1 below; NaN for a single score."""
    interquartile_mean: float
    """Mean without the lowest and the highest quarter, each rounded down: of fewer than four scores it is the mean."""
    low: float
    """Lower end of its 95 % bootstrap interval; NaN for a single score."""
    high: float


def summarize(scores: Sequence[float]) -> Summary:
    """Mean, spread, and interquartile mean with the interval that resampling the runs gives; always the same draws."""
    values = np.asarray(scores, np.float64)
    if values.size < 2:
        return Summary(1, float(values[0]), np.nan, float(values[0]), np.nan, np.nan)
    draws = np.random.default_rng(0).integers(0, values.size, (RESAMPLES, values.size))
    low, high = np.percentile(interquartile_mean(values[draws]), (2.5, 97.5))
    return Summary(
        values.size, values.mean(), values.std(ddof=1), float(interquartile_mean(values)), float(low), float(high)
    )


def interquartile_mean(scores: np.ndarray) -> np.ndarray:
    """Of the last axis: the mean without its lowest and highest quarter, each rounded down."""
    cut = scores.shape[-1] // 4
    ordered = np.sort(scores, axis=-1)
    return np.asarray(ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1))


def sample_std(scores: np.ndarray) -> np.ndarray:
    """Along the first axis, with n - 1 below; 0 of a single score, to draw no band around it."""
    return np.asarray(scores.std(axis=0, ddof=1 if len(scores) > 1 else 0))


def probability_of_improvement(scores: Sequence[float], others: Sequence[float]) -> float:
    """How often a run drawn from `scores` is better than one from `others`, a tie counting half (Mann and Whitney)."""
    ours, theirs = np.asarray(scores)[:, None], np.asarray(others)[None]
    return float(np.mean((ours > theirs) + 0.5 * (ours == theirs)))
