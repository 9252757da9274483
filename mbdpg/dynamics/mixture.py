"""The Mixture Gaussian Network of Section 4.1 (Eq. 5-10, 12, 13).

Everything here is in normalized units: observations by their mean and standard deviation, changes of observation by
theirs, rewards by their standard deviation (`Scales` holds the factors that connect them).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mbdpg.networks.mlp import MLP, Linear
from mbdpg.networks.normalizer import soft_bound

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0
"""Bounds of a component's log standard deviation, in standard deviations of the change of observation."""


class Memory(NamedTuple):
    """The LSTM's state; zeros at the start of an episode."""

    hidden: Float[Array, "*batch memory"]
    cell: Float[Array, "*batch memory"]


class Scales(eqx.Module):
    """Factors between the normalized units of one quantity and another; data, never trained."""

    delta: Float[Array, " observation"]
    """Standard deviation of the change of observation, in standard deviations of the observation."""
    reward: Float[Array, ""]
    """One unit of predicted reward, in units of the return scale."""
    terminal_reward: Float[Array, ""]
    """One unit of predicted terminal reward, in units of the return scale."""


class Prediction(NamedTuple):
    """Parameters of the mixture over the next change of observation (Eq. 8)."""

    log_weights: Float[Array, "*batch gaussian"]
    means: Float[Array, "*batch gaussian observation"]
    log_stds: Float[Array, "*batch gaussian observation"]

    def mean(self) -> Float[Array, "*batch observation"]:
        """Sum of weighted means, the deterministic prediction used for planning (Eq. 13)."""
        return jnp.sum(jnp.exp(self.log_weights)[..., None] * self.means, axis=-2)

    def sample(self, *, key: PRNGKeyArray) -> Float[Array, "*batch observation"]:
        """One draw of the mixture: a Gaussian by its weight (Eq. 5), then mu + sigma * epsilon (Eq. 12)."""
        which_key, noise_key = jax.random.split(key)
        which = jax.random.categorical(which_key, self.log_weights, axis=-1)[..., None, None]
        mean = jnp.take_along_axis(self.means, which, axis=-2)[..., 0, :]
        log_std = jnp.take_along_axis(self.log_stds, which, axis=-2)[..., 0, :]
        return mean + jnp.exp(log_std) * jax.random.normal(noise_key, mean.shape)


class Outcome(NamedTuple):
    """What a step brings beside the next observation: the mean of what may happen between its two ends."""

    reward: Float[Array, "*batch"]
    """Of a step that does not end the episode."""
    terminal_reward: Float[Array, "*batch"]
    """Of a step that does."""
    continue_logit: Float[Array, "*batch"]
    """Log odds that the episode goes on."""


@runtime_checkable
class Dynamics(Protocol):
    """What is trained over several steps and predicts open loop; the methods are described at `MixtureDynamics`."""

    def initial_memory(self, batch: tuple[int, ...]) -> Memory: ...

    def remember(self, memory: Memory, observation: Array, action: Array) -> Memory: ...

    def predict(self, memory: Memory, observation: Array, action: Array) -> Prediction: ...

    def outcome(self, memory: Memory, observation: Array, action: Array, delta: Array) -> Outcome: ...


class MixtureDynamics(eqx.Module):
    """LSTM memory, a trunk of dense layers with heads for M Gaussians, and a small network for a step's outcome.

    The trunk also sees the observation and action themselves, past the memory: one-step accuracy then does not have
    to pass through the LSTM's gates.
    """

    lstm: Linear
    trunk: MLP
    scale_head: Linear
    outcome_network: MLP
    gaussians: int = eqx.field(static=True)
    observation_size: int = eqx.field(static=True)

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        *,
        gaussians: int,
        memory: int,
        widths: tuple[int, ...],
        key: PRNGKeyArray,
    ):
        lstm_key, trunk_key, scale_key, outcome_key = jax.random.split(key, 4)
        pair = observation_size + action_size
        lstm = Linear(pair + memory, 4 * memory, key=lstm_key)
        # A forget bias of one lets a fresh memory keep what it holds.
        self.lstm = eqx.tree_at(lambda m: m.bias, lstm, lstm.bias.at[memory : 2 * memory].set(1.0))
        outputs = gaussians * (observation_size + 1)
        self.trunk = MLP(pair + memory, widths, outputs, output_scale=0.1, key=trunk_key)
        self.scale_head = Linear(widths[-1], gaussians * observation_size, scale=0.1, key=scale_key)
        inputs, narrow = pair + observation_size + memory, (max(widths[-1] // 2, 1),) * 2
        outcome = MLP(inputs, narrow, 3, output_scale=0.1, key=outcome_key)
        # Episodes rarely end: start from a survival of 98 % per step, not 50 %.
        self.outcome_network = eqx.tree_at(lambda m: m.output.bias, outcome, outcome.output.bias.at[-1].set(4.0))
        self.gaussians, self.observation_size = gaussians, observation_size

    def initial_memory(self, batch: tuple[int, ...]) -> Memory:
        """Zeros, the memory at an episode's start."""
        size = self.lstm.bias.shape[0] // 4
        return Memory(jnp.zeros((*batch, size)), jnp.zeros((*batch, size)))

    def remember(
        self, memory: Memory, observation: Float[Array, "*batch observation"], action: Float[Array, "*batch action"]
    ) -> Memory:
        """h_{t+1} = f_h(h_t, s_t, a_t) (Eq. 7)."""
        gates = self.lstm(jnp.concatenate([observation, action, memory.hidden], axis=-1))
        write, forget, candidate, read = jnp.split(gates, 4, axis=-1)
        cell = jax.nn.sigmoid(forget) * memory.cell + jax.nn.sigmoid(write) * jnp.tanh(candidate)
        return Memory(jax.nn.sigmoid(read) * jnp.tanh(cell), cell)

    def predict(
        self, memory: Memory, observation: Float[Array, "*batch observation"], action: Float[Array, "*batch action"]
    ) -> Prediction:
        """g(h_{t+1}) (Eq. 8), from the memory that has already seen this observation and action."""
        features = self.trunk.features(jnp.concatenate([observation, action, memory.hidden], axis=-1))
        out, lead = self.trunk.output(features), features.shape[:-1]
        m, o = self.gaussians, self.observation_size
        # The scales have a head of their own so that planning, which never reads them, does not compute them.
        raw_scales = self.scale_head(features).reshape(*lead, m, o)
        return Prediction(
            log_weights=jax.nn.log_softmax(out[..., m * o : m * o + m], axis=-1),
            means=out[..., : m * o].reshape(*lead, m, o),
            log_stds=LOG_STD_MIN + (LOG_STD_MAX - LOG_STD_MIN) * jax.nn.sigmoid(raw_scales),
        )

    def outcome(
        self,
        memory: Memory,
        observation: Float[Array, "*batch observation"],
        action: Float[Array, "*batch action"],
        delta: Float[Array, "*batch observation"],
    ) -> Outcome:
        """Reward and end of a step that changes the observation by `delta`.

        Args:
            memory: it has already seen this observation and action.
            observation: before the step.
            action: of the step.
            delta: mean of the change, or a draw of it. Rewards often pay for a change (of speed, of place); between
                two observations it would be a small difference of large numbers.
        """
        reward, terminal_reward, continue_logit = jnp.moveaxis(
            self.outcome_network(jnp.concatenate([observation, action, delta, memory.hidden], axis=-1)), -1, 0
        )
        return Outcome(reward, terminal_reward, continue_logit)


def next_observation(
    observation: Float[Array, "*batch observation"], delta: Float[Array, "*batch observation"], scales: Scales
) -> Float[Array, "*batch observation"]:
    """s_{t+1} = s_t + delta, in units of the observation and softly bounded (Eq. 9)."""
    factor = scales.delta.reshape((1,) * (delta.ndim - 1) + scales.delta.shape)
    return soft_bound(observation + delta * factor)
