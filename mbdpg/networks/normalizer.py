"""Scaling of observations to zero mean and unit variance."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

BOUND = 10.0
"""Normalized observations beyond this many standard deviations are treated as outliers."""


class Normalizer(eqx.Module):
    """Mean and standard deviation per observation entry, set from the replay and never trained."""

    mean: Float[Array, " observation"]
    std: Float[Array, " observation"]
    bound: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(BOUND, jnp.float32))
    """Outliers are clipped at this many standard deviations."""

    def __call__(self, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch observation"]:
        """Normalize and clip."""
        lead = (1,) * (observation.ndim - 1)
        scaled = (observation - self.mean.reshape(lead + self.mean.shape)) / self.std.reshape(lead + self.std.shape)
        return jnp.clip(scaled, -self.bound, self.bound)


def identity(size: int, *, bounded: bool = True) -> Normalizer:
    """The normalizer that clips at most."""
    bound = BOUND if bounded else float(np.finfo(np.float32).max)
    return Normalizer(jnp.zeros(size), jnp.ones(size), jnp.asarray(bound, jnp.float32))


def soft_bound(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Keep imagined states within `BOUND` + 1: identity inside `BOUND`, a tanh beyond.

    A hard clip has zero gradient outside and would silently remove the learning signal there.
    """
    inside = jnp.clip(x, -BOUND, BOUND)
    return inside + jnp.tanh(x - inside)
