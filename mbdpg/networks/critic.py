"""The clipped double critic Q (Eq. 17): independent networks stacked along a leading `critic` axis."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mbdpg.networks.mlp import MLP


class Critics(eqx.Module):
    """Q_i(s, a) for every critic i, from normalized observations; values are in units of the return scale."""

    mlps: MLP

    def __init__(
        self,
        observation: int,
        action: int,
        widths: Sequence[int],
        *,
        count: int = 2,
        plain: bool = False,
        key: PRNGKeyArray,
    ):
        def one(key: PRNGKeyArray) -> MLP:
            return MLP(observation + action, widths, 1, output_scale=0.0, plain=plain, key=key)

        self.mlps = eqx.filter_vmap(one)(jax.random.split(key, count))

    def __call__(
        self, observation: Float[Array, "*batch observation"], action: Float[Array, "*batch action"]
    ) -> Float[Array, "critic *batch"]:
        pair = jnp.concatenate([observation, action], axis=-1)
        # As one axis of rows, over which XLA sums weights' gradients without first transposing what it sums.
        rows = pair.reshape(-1, pair.shape[-1])
        values: Array = eqx.filter_vmap(lambda mlp, x: mlp(x), in_axes=(0, None))(self.mlps, rows)
        return values.reshape(-1, *pair.shape[:-1])
