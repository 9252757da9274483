"""Independent Gaussian networks of one step (Chua et al. 2018): the learned world of PETS and MBPO.

Networks see normalized units; `Units` connects them with raw ones, in which `predict` and its callers speak.
Leading axes are `member, batch`: every member has a batch of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mbdpg.dynamics.accuracy import errors_over_time
from mbdpg.interfaces import Batch, Metrics, Statistics
from mbdpg.networks.mlp import Linear
from mbdpg.networks.normalizer import Normalizer, identity

BOUNDS_WEIGHT = 0.01
"""Of the term that draws the learned bounds of the log variance together (Chua et al. 2018, Appendix A.1)."""

LOG_VARIANCE_MIN, LOG_VARIANCE_MAX = -10.0, 0.5
"""Its bounds before they are learned, in standard deviations of the change (ibid.)."""


class Units(eqx.Module):
    """One unit of what the networks see, in raw units; data, never trained."""

    normalizer: Normalizer
    delta: Float[Array, " observation"]
    """Of the change of observation."""
    reward: Float[Array, ""]
    terminal_reward: Float[Array, ""]

    @classmethod
    def of(cls, statistics: Statistics) -> Units:
        """Standard deviations of what a replay holds."""
        normalizer = Normalizer(statistics.observation_mean, statistics.observation_std)
        return cls(normalizer, statistics.delta_std, statistics.reward_std, statistics.terminal_reward_scale)

    @classmethod
    def raw(cls, observation_size: int) -> Units:
        """Before there is any experience."""
        return cls(identity(observation_size), jnp.ones(observation_size), jnp.ones(()), jnp.ones(()))


class Prediction(NamedTuple):
    """A Gaussian over what a step changes, and its end."""

    mean: Float[Array, "*batch change"]
    """Of the change of observation and, last, the reward."""
    log_variance: Float[Array, "*batch change"]
    terminal_reward: Float[Array, "*batch"]
    """Of a step that ends the episode."""
    continue_logit: Float[Array, "*batch"]
    """Log odds that the episode goes on."""


class Network(eqx.Module):
    """One member: dense layers with SiLU, and a Gaussian whose log variance is softly kept within learned bounds."""

    hidden: tuple[Linear, ...]
    output: Linear
    max_log_variance: Float[Array, " change"]
    min_log_variance: Float[Array, " change"]

    def __init__(self, observation_size: int, action_size: int, widths: tuple[int, ...], *, key: PRNGKeyArray):
        change = observation_size + 1
        sizes = [observation_size + action_size, *widths]
        keys = jax.random.split(key, len(sizes))
        self.hidden = tuple(Linear(a, b, key=k) for a, b, k in zip(sizes, widths, keys[:-1], strict=False))
        output = Linear(sizes[-1], 2 * change + 2, scale=0.1, key=keys[-1])
        # Episodes rarely end: start from a survival of 98 % per step, not 50 %.
        self.output = eqx.tree_at(lambda m: m.bias, output, output.bias.at[-1].set(4.0))
        self.min_log_variance = jnp.full(change, LOG_VARIANCE_MIN)
        self.max_log_variance = jnp.full(change, LOG_VARIANCE_MAX)

    def __call__(
        self, observation: Float[Array, "batch observation"], action: Float[Array, "batch action"]
    ) -> Prediction:
        x = jnp.concatenate([observation, action], axis=-1)
        for linear in self.hidden:
            x = jax.nn.silu(linear(x))
        x, change = self.output(x), self.max_log_variance.shape[0]
        high, low = self.max_log_variance[None], self.min_log_variance[None]
        log_variance = high - jax.nn.softplus(high - x[:, change : 2 * change])
        return Prediction(x[:, :change], low + jax.nn.softplus(log_variance - low), x[:, -2], x[:, -1])


class Ensemble(eqx.Module):
    """Members stacked along a leading `member` axis."""

    members: Network

    def __init__(
        self, observation_size: int, action_size: int, *, count: int, widths: tuple[int, ...], key: PRNGKeyArray
    ):
        self.members = eqx.filter_vmap(lambda k: Network(observation_size, action_size, widths, key=k))(
            jax.random.split(key, count)
        )

    def chosen(self, members: Int[Array, " chosen"]) -> Ensemble:
        """An ensemble of some of these members."""
        return jax.tree.map(lambda x: x[members], self)

    def __call__(
        self, observation: Float[Array, "member batch observation"], action: Float[Array, "member batch action"]
    ) -> Prediction:
        """Every member's prediction of its own batch, in normalized units."""
        prediction: Prediction = eqx.filter_vmap(lambda member, o, a: member(o, a))(self.members, observation, action)
        return prediction


def ensemble_loss(
    ensemble: Ensemble, units: Units, batch: Batch, *, weight_decay: float
) -> tuple[Float[Array, ""], Metrics]:
    """Gaussian negative log-likelihood (Chua et al. 2018, Eq. 1) summed over members, with the heads the tasks need.

    To it come the squared error of the terminal reward on terminal steps alone, the cross entropy of the end, half the
    squared weights, and the term that draws the bounds of the log variance together.

    Args:
        ensemble: the networks.
        units: theirs.
        batch: raw, shape (member, batch, ...).
        weight_decay: weight of half the sum of squared weights.
    """
    prediction = ensemble(units.normalizer(batch.observation), batch.action)
    target, weight = _target(units, batch)
    nll = weight * (jnp.square(prediction.mean - target) * jnp.exp(-prediction.log_variance) + prediction.log_variance)
    nll = jnp.sum(jnp.mean(nll, axis=(1, 2)))
    terminal_error = jnp.square(prediction.terminal_reward - batch.reward / units.terminal_reward) * batch.terminated
    logit = prediction.continue_logit
    ending = (1 - batch.terminated) * jax.nn.softplus(-logit) + batch.terminated * jax.nn.softplus(logit)
    ends = jnp.sum(jnp.mean(terminal_error + ending, axis=1))
    members = ensemble.members
    bounds = jnp.sum(members.max_log_variance) - jnp.sum(members.min_log_variance)
    weights = sum(jnp.sum(jnp.square(linear.weight)) for linear in (*members.hidden, members.output))
    count = prediction.mean.shape[0]
    return nll + ends + BOUNDS_WEIGHT * bounds + 0.5 * weight_decay * weights, {
        "dynamics/nll": nll / count,
        "dynamics/continue_bce": jnp.mean(ending),
    }


def held_out_error(ensemble: Ensemble, units: Units, batch: Batch) -> Float[Array, " member"]:
    """Each member's mean squared error, in normalized units, on steps (batch, ...) it does not learn from."""
    batch = for_each(ensemble, batch)
    prediction = ensemble(units.normalizer(batch.observation), batch.action)
    target, weight = _target(units, batch)
    return jnp.mean(weight * jnp.square(prediction.mean - target), axis=(1, 2))


def for_each(ensemble: Ensemble, batch: Batch) -> Batch:
    """The same steps for every member."""
    count = ensemble.members.output.bias.shape[0]
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), batch)


def _target(units: Units, batch: Batch) -> tuple[Array, Array]:
    """What the Gaussian is of, and its weights: the reward of a terminal step belongs to a head of its own."""
    delta = (batch.next_observation - batch.observation) / units.delta[None, None]
    target = jnp.concatenate([delta, (batch.reward / units.reward)[..., None]], axis=-1)
    return target, jnp.ones_like(target).at[..., -1].set(1.0 - batch.terminated)


class Step(NamedTuple):
    """An imagined step in raw units."""

    next_observation: Float[Array, "*batch observation"]
    reward: Float[Array, "*batch"]
    """Of a step that goes on."""
    terminal_reward: Float[Array, "*batch"]
    continues: Float[Array, "*batch"]
    """Probability that the episode goes on."""


def predict(
    ensemble: Ensemble,
    units: Units,
    observation: Float[Array, "member batch observation"],
    action: Float[Array, "member batch action"],
    *,
    key: PRNGKeyArray | None = None,
) -> Step:
    """Every member's next step from raw observations of its own: a draw or, without a key, the mean."""
    prediction = ensemble(units.normalizer(observation), action)
    change = prediction.mean
    if key is not None:
        change += jnp.exp(0.5 * prediction.log_variance) * jax.random.normal(key, change.shape)
    return Step(
        next_observation=observation + change[..., :-1] * units.delta[None, None],
        reward=change[..., -1] * units.reward,
        terminal_reward=prediction.terminal_reward * units.terminal_reward,
        continues=jax.nn.sigmoid(prediction.continue_logit),
    )


def open_loop_error(ensemble: Ensemble, units: Units, batch: Batch) -> Float[Array, "time 2"]:
    """`mbdpg.dynamics.accuracy.errors_over_time` of the members' open-loop predictions, averaged.

    Args:
        ensemble: the networks, each of which follows its own mean.
        units: theirs.
        batch: raw windows, shape (batch, time, ...).
    """
    windows = for_each(ensemble, batch)
    start = windows.observation[:, :, 0]

    def step(observation: Array, action: Array) -> tuple[Array, Array]:
        after = predict(ensemble, units, observation, action).next_observation
        return after, jnp.mean(after, axis=0)

    reached = jax.lax.scan(step, start, jnp.moveaxis(windows.action, 2, 0))[1]
    reached, begun, truth = map(units.normalizer, (reached, batch.observation[:, 0], batch.next_observation))
    return errors_over_time(reached, begun, truth, batch.valid)
