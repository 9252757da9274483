"""The policies: deterministic (mu) or Gaussian, in JAX for learning and in NumPy for acting."""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from mbdpg.networks.mlp import MLP, Linear
from mbdpg.networks.normalizer import Normalizer


class Policy(eqx.Module):
    """a = tanh(mlp(s)): actions in [-1, 1] from normalized observations."""

    mlp: MLP

    def __init__(self, observation: int, action: int, widths: Sequence[int], *, plain: bool = False, key: PRNGKeyArray):
        # A small output layer starts every action near zero, where tanh passes its gradient.
        self.mlp = MLP(observation, widths, action, output_scale=0.01, plain=plain, key=key)

    def __call__(self, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch action"]:
        return jnp.tanh(self.mlp(observation))


LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
"""Bounds of a Gaussian policy's log standard deviation, before tanh (Haarnoja et al. 2018)."""


class GaussianPolicy(eqx.Module):
    """a = tanh(mean(s) + std(s) * noise): a Gaussian squashed into [-1, 1]."""

    center: Policy
    """Its deterministic policy."""
    spread: Linear
    """Log standard deviation from the last hidden layer."""

    def __init__(self, observation: int, action: int, widths: Sequence[int], *, plain: bool = False, key: PRNGKeyArray):
        center_key, spread_key = jax.random.split(key)
        self.center = Policy(observation, action, widths, plain=plain, key=center_key)
        self.spread = Linear([observation, *widths][-1], action, scale=0.01, uniform=plain, key=spread_key)

    def sample(
        self, observation: Float[Array, "*batch observation"], *, key: PRNGKeyArray
    ) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch"]]:
        """Actions and their log densities, for gradients through both (Haarnoja et al. 2018, Appendix C)."""
        features = self.center.mlp.features(observation)
        log_std = jnp.clip(self.spread(features), LOG_STD_MIN, LOG_STD_MAX)
        noise = jax.random.normal(key, log_std.shape)
        unbounded = self.center.mlp.output(features) + jnp.exp(log_std) * noise
        density = -0.5 * jnp.square(noise) - log_std - 0.5 * math.log(2 * math.pi)
        # log(1 - tanh(x)^2), which rounds to log(0) when written so.
        density -= 2.0 * (math.log(2.0) - unbounded - jax.nn.softplus(-2.0 * unbounded))
        return jnp.tanh(unbounded), jnp.sum(density, axis=-1)


class NumpyPolicy:
    """The same policies for one raw observation at a time, without JAX's dispatch: some tens of microseconds.

    Attributes:
        arrays: the parameters by name, as in the files under a run's `policy/`.
        memory: nothing; see `mbdpg.interfaces.Acting`.
    """

    def __init__(self, arrays: dict[str, np.ndarray]):
        """Take parameters named as `policy_arrays` names them.

        Raises:
            ValueError: a parameter is missing, misshapen or not finite.
        """
        self.arrays = {name: np.asarray(value, np.float32, order="C") for name, value in arrays.items()}
        self.memory: list[float] = []
        layers = sum(name.startswith("hidden/") and name.endswith("/weight") for name in arrays)
        plain = not any(name.endswith(("/scale", "/offset")) for name in arrays)
        parts = ("weight", "bias") if plain else ("weight", "bias", "scale", "offset")
        try:
            self._mean, self._std, self._bound = (self.arrays[name] for name in ("mean", "std", "bound"))
            self._hidden = [tuple(self.arrays[f"hidden/{i}/{part}"] for part in parts) for i in range(layers)]
            self._output = self.arrays["output/weight"], self.arrays["output/bias"]
            self._spread = None
            if any(name.startswith("spread/") for name in arrays):
                self._spread = self.arrays["spread/weight"], self.arrays["spread/bias"]
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
        weight, bias = self._output
        return np.tanh(self._features(observation) @ weight + bias)

    def explore(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """An action to learn from, of shape (action,).

        Args:
            observation: raw, of shape (observation,).
            noise: of shape (action,). A Gaussian policy multiplies it with its own standard deviation and squashes
                the sum, for a deterministic one it is added to the action.
        """
        if self._spread is None:
            return np.clip(self(observation) + noise, -1.0, 1.0).astype(np.float32)
        features = self._features(observation)
        (weight, bias), (spread_weight, spread_bias) = self._output, self._spread
        std = np.exp(np.clip(features @ spread_weight + spread_bias, LOG_STD_MIN, LOG_STD_MAX))
        return np.tanh(features @ weight + bias + std * noise).astype(np.float32)

    def reset(self) -> None:
        """Nothing: one episode leaves no trace in the next."""

    def _features(self, observation: np.ndarray) -> np.ndarray:
        x = np.asarray(observation, np.float32)
        if x.shape != self._mean.shape:
            raise ValueError(f"the policy takes observations of shape {self._mean.shape}, not {x.shape}")
        # In NumPy's ufuncs alone: its mean, clip and where take longer than a layer's product.
        x = np.minimum(np.maximum((x - self._mean) / self._std, -self._bound), self._bound)
        for weight, bias, *norm in self._hidden:
            x = x @ weight + bias
            if not norm:
                x = np.maximum(x, 0)
                continue
            scale, offset = norm
            x -= np.add.reduce(x) / np.float32(x.size)
            x *= scale / np.sqrt(np.dot(x, x) / x.size + np.float32(1e-5))
            x += offset
            x = np.maximum(x, 0) + (np.exp(np.minimum(x, 0)) - 1)
        return x

    def _check(self) -> None:
        shapes = self._mean.shape, self._std.shape, self._bound.shape
        if self._mean.ndim != 1 or shapes != (self._mean.shape, self._mean.shape, ()):
            raise ValueError(f"the policy's normalizer has shapes {shapes}")
        width = self._mean.shape[0]
        for weight, *vectors in self._hidden:
            if weight.ndim != 2 or weight.shape[0] != width or {v.shape for v in vectors} != {weight.shape[1:]}:
                raise ValueError(f"the policy's layers do not fit together at one of shape {weight.shape}")
            width = weight.shape[1]
        weight, bias = self._output
        if weight.ndim != 2 or weight.shape[0] != width or bias.shape != weight.shape[1:]:
            raise ValueError(f"the policy's output {weight.shape} does not fit a layer of width {width}")
        if self._spread is not None and [x.shape for x in self._spread] != [x.shape for x in self._output]:
            raise ValueError(f"the policy's spread {self._spread[0].shape} does not fit its output {weight.shape}")
        for name, value in self.arrays.items():
            if not np.isfinite(value).all():
                raise ValueError(f"the policy's array {name} is not finite")
        for name in ("std", "bound"):
            if not (self.arrays[name] > 0).all():
                raise ValueError(f"the policy's array {name} is not positive")


def policy_arrays(policy: Policy | GaussianPolicy, normalizer: Normalizer) -> dict[str, np.ndarray]:
    """The policy with its normalizer as named float32 arrays, for `NumpyPolicy` and for the run folder."""
    arrays: dict[str, Array] = {"mean": normalizer.mean, "std": normalizer.std, "bound": normalizer.bound}
    if isinstance(policy, GaussianPolicy):
        arrays |= {"spread/weight": policy.spread.weight, "spread/bias": policy.spread.bias}
        policy = policy.center
    for i, linear in enumerate(policy.mlp.hidden):
        arrays |= {f"hidden/{i}/weight": linear.weight, f"hidden/{i}/bias": linear.bias}
    for i, norm in enumerate(policy.mlp.norms):
        arrays |= {f"hidden/{i}/scale": norm.scale, f"hidden/{i}/offset": norm.offset}
    arrays |= {"output/weight": policy.mlp.output.weight, "output/bias": policy.mlp.output.bias}
    return {name: np.asarray(value) for name, value in arrays.items()}
