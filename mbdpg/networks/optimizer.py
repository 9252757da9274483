"""Adam, as all agents and models use it."""

from __future__ import annotations

import optax


def adam(learning_rate: float, *, clip: float | None = None) -> optax.GradientTransformation:
    """Adam (Kingma and Ba 2015), of a gradient clipped to a global norm if one is given.

    An update whose gradient is not finite is skipped and counted, however many come in a row.
    """
    step = optax.adam(learning_rate)
    if clip is not None:
        step = optax.chain(optax.clip_by_global_norm(clip), step)
    return optax.apply_if_finite(step, max_consecutive_errors=10**9)
