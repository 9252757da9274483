"""Eq. 14-20 as equations, nothing else. Corrections to the printed ones are argued in docs/deviations.md."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from mbdpg.interfaces import Metrics

RewardWeights = Literal["uniform", "remaining"]
ActorValue = Literal["clipped", "mean"]


def clipped_value(values: Float[Array, "critic *batch"]) -> Float[Array, "*batch"]:
    """Q = min_i Q_i (Eq. 17); each critic is regressed by itself."""
    return jnp.min(values, axis=0)


def climbed_value(values: Float[Array, "critic *batch"], actor_value: ActorValue) -> Float[Array, "*batch"]:
    """What the actor climbs: the clipped value, or the critics' mean, as in REDQ (Chen et al. 2021)."""
    return clipped_value(values) if actor_value == "clipped" else jnp.mean(values, axis=0)


def smoothed_action(
    action: Float[Array, "*batch"], std: float, clip: float, *, key: PRNGKeyArray
) -> Float[Array, "*batch"]:
    """Target policy smoothing (TD3, Fujimoto et al. 2018, Eq. 14): the action plus clipped normal noise, in [-1, 1]."""
    return jnp.clip(action + jnp.clip(std * jax.random.normal(key, action.shape), -clip, clip), -1.0, 1.0)


def temporal_difference_target(
    reward: Float[Array, " batch"],
    terminated: Float[Array, " batch"],
    next_value: Float[Array, " batch"],
    discount: float,
) -> Float[Array, " batch"]:
    """r + gamma (1 - d) Q(s', a') (Eq. 14, with the termination it omits)."""
    return reward + discount * (1.0 - terminated) * next_value


def expanded_values(
    rewards: Float[Array, "time batch"],
    continues: Float[Array, "time batch"],
    next_values: Float[Array, "time batch"],
    discount: float,
    trace: float | Float[Array, "time batch"],
) -> Float[Array, "time batch"]:
    """The value expansion of Eq. 16: for every t, sum_{h=t}^{H-1} gamma^{h-t} r_{h+1} + gamma^{H-t} Q(s_H, a_H).

    As printed the powers are gamma^h, which would teach Q(s_t) the value gamma^t Q for t > 0. Beyond the paper, each
    step counts by the probability of still being alive, and `trace` (lambda) < 1 averages over shorter expansions
    geometrically, as in TD(lambda): 1 is Eq. 16, 0 the one-step target. Of real steps, a trace of 0 where none follows
    makes them returns to the last one.
    """

    def step(after: Array, inputs: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        reward, alive, next_value, share = inputs
        target = reward + discount * alive * ((1.0 - share) * next_value + share * after)
        return target, target

    steps = (rewards, continues, next_values, jnp.full(rewards.shape, trace, rewards.dtype))
    return jax.lax.scan(step, next_values[-1], steps, reverse=True)[1]


def likeness(
    actions: Float[Array, "*batch action"], others: Float[Array, "*batch action"], tolerance: float
) -> Float[Array, "*batch"]:
    """1 where actions are the same, e^(-1/2) where they are `tolerance` apart in root mean square."""
    return jnp.exp(-0.5 * jnp.mean(jnp.square((actions - others) / tolerance), axis=-1))


def critic_loss(
    values: Float[Array, "critic *batch"],
    targets: Float[Array, "*batch"],
    weights: Float[Array, "*batch"],
    *,
    huber_delta: float = 0.0,
    huber_share: float | Float[Array, ""] = 1.0,
) -> Float[Array, ""]:
    """Weighted mean square error of every critic to one shared target (Eq. 14, 16), summed over the critics.

    A `huber_delta` above 0 is the size of error beyond which the square goes on as its tangent (Huber 1964), so that
    a few large errors do not outweigh all others; such is `huber_share` of the loss.
    """
    errors = values - jax.lax.stop_gradient(targets)[None]
    losses = jnp.square(errors)
    if huber_delta > 0.0:
        huber = 2.0 * optax.losses.huber_loss(errors, delta=huber_delta)
        losses = (1.0 - huber_share) * losses + huber_share * huber
    return jnp.sum(losses * weights[None]) / jnp.maximum(jnp.sum(weights), 1.0)


def policy_objective(
    rewards: Float[Array, "time batch"],
    values: Float[Array, "value batch"],
    survival: Float[Array, "state batch"],
    *,
    discount: float,
    beta: Float[Array, ""],
    reward_weights: RewardWeights,
) -> Float[Array, " batch"]:
    """J = beta sum_{t<H} gamma^t r_{t+1} + sum_t gamma^t Q(s_t, a_t) (Eq. 18), per value term.

    Args:
        rewards: imagined, H of them.
        values: Q along the trajectory to t = H: H of them from t = 1 as printed, or more or fewer from another t.
        survival: probability of being alive at each of the H + 1 states.
        discount: gamma.
        beta: weight of the imagined rewards.
        reward_weights: "uniform" as printed; "remaining" weighs a reward by the number of value terms that follow it.
            Only then is J, with beta = 1, the sum of all n-step returns, in which every reward counts alike whether
            it falls before or behind a value term.
    """
    horizon = rewards.shape[0]
    powers = discount ** jnp.arange(horizon + 1, dtype=rewards.dtype)[:, None] * survival
    remaining = jnp.minimum(horizon - jnp.arange(horizon, dtype=rewards.dtype), values.shape[0])
    weights = beta * (remaining if reward_weights == "remaining" else jnp.ones_like(remaining))
    total = jnp.sum(weights[:, None] * powers[:-1] * rewards, axis=0)
    total += jnp.sum(powers[horizon + 1 - values.shape[0] :] * values, axis=0)
    return total / values.shape[0]


def cloning_loss(actions: Float[Array, "batch action"], demonstrated: Float[Array, "batch action"]) -> Float[Array, ""]:
    """Behavioral cloning, E[(mu(s) - a)^2] (Eq. 15)."""
    return jnp.mean(jnp.sum(jnp.square(actions - demonstrated), axis=-1))


def value_bias(value: Float[Array, " batch"], realized_return: Float[Array, " batch"]) -> Metrics:
    """Means of a critic's value and of the discounted return that followed, where that is known (not NaN)."""
    known = jnp.isfinite(realized_return)
    count = jnp.sum(known.astype(value.dtype))  # 0 gives NaN: nothing is known
    realized = jnp.sum(jnp.where(known, realized_return, 0.0)) / count
    return {
        "critic/q_bias": jnp.sum(jnp.where(known, value, 0.0)) / count - realized,
        "critic/realized_return": realized,
    }
