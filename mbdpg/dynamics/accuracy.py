"""How far a model's open-loop predictions are off, for models of every kind."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mbdpg.interfaces import Metrics

DEPTHS = (1, 5, 10, 20)
"""Imagined steps after which the instruments look."""


def errors_at_depth(
    reached: Float[Array, "time batch observation"],
    start: Float[Array, "batch observation"],
    truth: Float[Array, "batch time observation"],
    exists: Float[Array, "batch time"],
    depths: tuple[int, ...],
) -> Metrics:
    """Root mean square error of open-loop prediction at some depths, beside that of persistence (no change at all).

    Args:
        reached: the model's observations after 1, 2, ... steps, in standard deviations.
        start: the real observation before them.
        truth: the real observations after them.
        exists: 1 where there is one, 0 after an episode's end; a depth that no window reaches is NaN.
        depths: steps after which to look.
    """
    metrics: Metrics = {}
    for depth in depths:
        there = exists[:, depth - 1]
        for name, guess in (("rmse", reached[depth - 1]), ("persistence", start)):
            square = jnp.mean(jnp.square(guess - truth[:, depth - 1]), axis=-1)
            metrics[f"dynamics/{name}_k{depth:02d}"] = jnp.sqrt(jnp.sum(square * there) / jnp.sum(there))
    return metrics
