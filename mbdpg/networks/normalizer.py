"""Scaling of observations to zero mean and unit variance."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

BOUND = 10.0
"""Normalized observations beyond this many standard deviations are treated as outliers."""


class Normalizer(eqx.Module):
    """Mean and standard deviation per observation entry, set from the replay and never trained."""

    mean: Float[Array, " observation"]
    std: Float[Array, " observation"]

    def __call__(self, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch observation"]:
        """Normalize, and clip at `BOUND` standard deviations."""
        lead = (1,) * (observation.ndim - 1)
        scaled = (observation - self.mean.reshape(lead + self.mean.shape)) / self.std.reshape(lead + self.std.shape)
        return jnp.clip(scaled, -BOUND, BOUND)


def identity(size: int) -> Normalizer:
    """The normalizer that only clips."""
    return Normalizer(jnp.zeros(size), jnp.ones(size))


def soft_bound(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Keep imagined states within `BOUND` + 1: identity inside `BOUND`, a tanh beyond.

    A hard clip has zero gradient outside and would silently remove the learning signal there.
    """
    inside = jnp.clip(x, -BOUND, BOUND)
    return inside + jnp.tanh(x - inside)
