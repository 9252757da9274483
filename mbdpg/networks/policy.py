"""The deterministic policy mu, in JAX for learning and in NumPy for acting."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from mbdpg.networks.mlp import MLP
from mbdpg.networks.normalizer import BOUND, Normalizer


class Policy(eqx.Module):
    """a = tanh(mlp(s)): actions in [-1, 1] from normalized observations."""

    mlp: MLP

    def __init__(self, observation: int, action: int, widths: Sequence[int], *, key: PRNGKeyArray):
        # A small output layer starts every action near zero, where tanh passes its gradient.
        self.mlp = MLP(observation, widths, action, output_scale=0.01, key=key)

    def __call__(self, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch action"]:
        return jnp.tanh(self.mlp(observation))


class NumpyPolicy:
    """The same policy for one raw observation at a time, without JAX's dispatch: some tens of microseconds.

    Attributes:
        arrays: the parameters by name, as in the files under a run's `policy/`.
    """

    def __init__(self, arrays: dict[str, np.ndarray]):
        """Take parameters named as `policy_arrays` names them.

        Raises:
            ValueError: a parameter is missing, misshapen or not finite.
        """
        self.arrays = {name: np.ascontiguousarray(value, np.float32) for name, value in arrays.items()}
        layers = sum(name.startswith("hidden/") and name.endswith("/weight") for name in arrays)
        try:
            self._mean, self._std = self.arrays["mean"], self.arrays["std"]
            self._hidden = [
                tuple(self.arrays[f"hidden/{i}/{part}"] for part in ("weight", "bias", "scale", "offset"))
                for i in range(layers)
            ]
            self._output = self.arrays["output/weight"], self.arrays["output/bias"]
        except KeyError as missing:
            raise ValueError(f"the policy has no array {missing}") from None
        self._check()

    @property
    def observation_size(self) -> int:
        return int(self._mean.shape[0])

    @property
    def action_size(self) -> int:
        return int(self._output[1].shape[0])

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The action, float32 in [-1, 1] of shape (action,), for a raw observation of shape (observation,)."""
        x = np.asarray(observation, np.float32)
        if x.shape != self._mean.shape:
            raise ValueError(f"the policy takes observations of shape {self._mean.shape}, not {x.shape}")
        x = np.clip((x - self._mean) / self._std, -BOUND, BOUND)
        for weight, bias, scale, offset in self._hidden:
            x = x @ weight + bias
            x -= x.mean()
            x *= scale / np.sqrt(np.dot(x, x) / x.size + np.float32(1e-5))
            x += offset
            x = np.where(x > 0, x, np.exp(np.minimum(x, 0)) - 1)
        weight, bias = self._output
        return np.tanh(x @ weight + bias)

    def _check(self) -> None:
        if self._mean.ndim != 1 or self._std.shape != self._mean.shape:
            raise ValueError(f"the policy's normalizer has shapes {self._mean.shape} and {self._std.shape}")
        width = self._mean.shape[0]
        for weight, bias, scale, offset in self._hidden:
            if (
                weight.ndim != 2
                or weight.shape[0] != width
                or {bias.shape, scale.shape, offset.shape} != {weight.shape[1:]}
            ):
                raise ValueError(f"the policy's layers do not fit together at one of shape {weight.shape}")
            width = weight.shape[1]
        weight, bias = self._output
        if weight.ndim != 2 or weight.shape[0] != width or bias.shape != weight.shape[1:]:
            raise ValueError(f"the policy's output {weight.shape} does not fit a layer of width {width}")
        for name, value in self.arrays.items():
            if not np.isfinite(value).all():
                raise ValueError(f"the policy's array {name} is not finite")
        if not (self._std > 0).all():
            raise ValueError("the policy's array std is not positive")


def policy_arrays(policy: Policy, normalizer: Normalizer) -> dict[str, np.ndarray]:
    """The policy with its normalizer as named float32 arrays, for `NumpyPolicy` and for the run folder."""
    arrays: dict[str, Array] = {"mean": normalizer.mean, "std": normalizer.std}
    for i, (linear, norm) in enumerate(zip(policy.mlp.hidden, policy.mlp.norms, strict=True)):
        arrays |= {f"hidden/{i}/weight": linear.weight, f"hidden/{i}/bias": linear.bias}
        arrays |= {f"hidden/{i}/scale": norm.scale, f"hidden/{i}/offset": norm.offset}
    arrays |= {"output/weight": policy.mlp.output.weight, "output/bias": policy.mlp.output.bias}
    return {name: np.asarray(value) for name, value in arrays.items()}
