"""How far a model's open-loop predictions are off, for models of every kind."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mbdpg.interfaces import Metrics

DEPTHS = (1, 5, 10, 20)
"""Imagined steps after which the instruments look."""


def errors_over_time(
    reached: Float[Array, "time batch observation"],
    start: Float[Array, "batch observation"],
    truth: Float[Array, "batch time observation"],
    exists: Float[Array, "batch time"],
) -> Float[Array, "time 2"]:
    """Root mean square error after each open-loop step, and beside it that of persistence (no change at all).

    Args:
        reached: the model's observations after 1, 2, ... steps, in standard deviations.
        start: the real observation before them.
        truth: the real observations after them.
        exists: 1 where there is one, 0 after an episode's end; a depth that no window reaches is NaN.
    """
    truth, there = jnp.swapaxes(truth, 0, 1), jnp.swapaxes(exists, 0, 1)
    count = jnp.sum(there, axis=1)

    def error(guess: Array) -> Array:
        return jnp.sqrt(jnp.sum(jnp.mean(jnp.square(guess - truth), axis=-1) * there, axis=1) / count)

    return jnp.stack([error(reached), error(start[None])], axis=1)


def error_metrics(errors: Float[Array, "time 2"]) -> Metrics:
    """Those at `DEPTHS`, by name."""
    names = ("rmse", "persistence")
    return {f"dynamics/{name}_k{depth:02d}": errors[depth - 1, i] for depth in DEPTHS for i, name in enumerate(names)}
