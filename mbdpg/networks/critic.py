"""The clipped double critic Q (Eq. 17): independent networks stacked along a leading `critic` axis."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mbdpg.networks.mlp import MLP, Slopes


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
        rows = _rows(observation, action)
        values: Array = eqx.filter_vmap(lambda mlp, x: mlp(x), in_axes=(0, None))(self.mlps, rows)
        return values.reshape(-1, *observation.shape[:-1])

    def with_slopes(
        self, observation: Float[Array, "*batch observation"], action: Float[Array, "*batch action"]
    ) -> tuple[Float[Array, "critic *batch"], Slopes]:
        """Values, and all their derivatives (leading axis `critic`; of all of `batch`, `row`).

        By what a critic sees, values have the derivative they always have; by its parameters none, which is what
        `weighted_gradient` makes of the slopes. So the actor's loss and the critics' own cost one way through the
        critics and back.
        """
        rows = _rows(observation, action)
        mlps, here = jax.lax.stop_gradient((self.mlps, rows))
        slopes: Slopes = eqx.filter_vmap(MLP.slopes, in_axes=(0, None))(mlps, here)
        zero = (rows - here)[None]  # with a derivative
        values = slopes.output + jnp.sum(slopes.by_input * zero, axis=-1)
        return values.reshape(-1, *observation.shape[:-1]), slopes

    def weighted_gradient(self, slopes: Slopes, weights: Float[Array, "critic *batch"]) -> Critics:
        """The derivative of the values' weighted sum by every parameter."""
        rows = weights.reshape(weights.shape[0], -1)
        return eqx.tree_at(lambda x: x.mlps, self, eqx.filter_vmap(MLP.weighted_gradient)(self.mlps, slopes, rows))


def _rows(observation: Array, action: Array) -> Array:
    """What a critic sees, as one axis of rows: XLA sums weights' gradients over it without first transposing."""
    pair = jnp.concatenate([observation, action], axis=-1)
    return pair.reshape(-1, pair.shape[-1])
