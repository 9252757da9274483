"""Multi-step training of the dynamics (Section 4.1.2, Eq. 11) and its error on data it has not seen."""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mbdpg.dynamics.accuracy import errors_over_time
from mbdpg.dynamics.mixture import Dynamics, Memory, Prediction, Scales, next_observation
from mbdpg.interfaces import Metrics

Likelihood = Literal["mixture", "eq11"]


class Window(NamedTuple):
    """Consecutive steps of one episode in normalized units; `valid` is 0 before its start and after its end."""

    observation: Float[Array, "*batch time observation"]
    action: Float[Array, "*batch time action"]
    next_observation: Float[Array, "*batch time observation"]
    reward: Float[Array, "*batch time"]
    terminal_reward: Float[Array, "*batch time"]
    terminated: Float[Array, "*batch time"]
    valid: Float[Array, "*batch time"]


def warm_memory(dynamics: Dynamics, past: Window) -> Memory:
    """The memory after real steps, teacher-forced from zeros; steps that are not valid leave it at zero."""

    def step(memory: Memory, inputs: tuple[Array, Array, Array]) -> tuple[Memory, None]:
        observation, action, exists = inputs
        new = dynamics.remember(memory, observation, action)
        return Memory(new.hidden * exists[:, None], new.cell * exists[:, None]), None

    inputs = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (past.observation, past.action, past.valid))
    return jax.lax.scan(step, dynamics.initial_memory(past.valid.shape[:1]), inputs)[0]


def open_loop(
    dynamics: Dynamics,
    scales: Scales,
    start: Float[Array, "batch observation"],
    memory: Memory,
    actions: Float[Array, "batch time action"],
) -> tuple[Prediction, Float[Array, "state batch observation"], Memory]:
    """Execute `actions` in the model from a real state, feeding its own predictions back (Fig. 2).

    Returns:
        The predictions of every step, time first, the observations passed through, from `start` to the last, and the
        memory after every step.
    """

    def step(
        carry: tuple[Array, Memory], action: Array
    ) -> tuple[tuple[Array, Memory], tuple[Prediction, Array, Memory]]:
        observation, memory = carry
        memory = dynamics.remember(memory, observation, action)
        prediction = dynamics.predict(memory, observation, action)
        after = next_observation(observation, prediction.mean(), scales)
        return (after, memory), (prediction, after, memory)

    prediction, reached, memories = jax.lax.scan(step, (start, memory), jnp.swapaxes(actions, 0, 1))[1]
    return prediction, jnp.concatenate([start[None], reached]), memories


def mixture_nll(
    prediction: Prediction, target: Float[Array, "*batch observation"], likelihood: Likelihood
) -> Float[Array, "*batch"]:
    """Negative log-likelihood per observation entry, without its constant.

    `mixture` is that of the mixture itself, -log sum_i alpha_i p_i. `eq11` is the paper's -sum_i alpha_i log p_i,
    an upper bound of it (Jensen) that is linear in alpha, so that the best weights for an input are one-hot.
    """
    normed = (target[..., None, :] - prediction.means) * jnp.exp(-prediction.log_stds)
    log_p = -jnp.sum(0.5 * jnp.square(normed) + prediction.log_stds, axis=-1)
    if likelihood == "eq11":
        nll = -jnp.sum(jnp.exp(prediction.log_weights) * log_p, axis=-1)
    else:
        nll = -jax.nn.logsumexp(prediction.log_weights + log_p, axis=-1)
    return nll / target.shape[-1]


def dynamics_loss(
    dynamics: Dynamics,
    scales: Scales,
    window: Window,
    *,
    burn_in: int,
    likelihood: Likelihood,
    mean_weight: float,
) -> tuple[Float[Array, ""], Metrics]:
    """Eq. 11 over L open-loop steps after `burn_in` teacher-forced ones, with the heads the tasks need.

    To the likelihood of the state and the squared error of the reward come the squared error of the mixture's mean
    (planning uses nothing else), the squared error of the terminal reward on terminal steps alone, and the cross
    entropy of the continuation. Rewards and ends are learned between the real ends of a step, with the memory of the
    imagined ones: learned between imagined ends, the reward for a leg that touches the ground is paid at every step in
    which it may have touched. Steps after an episode's end do not count.
    """
    memory = warm_memory(dynamics, jax.tree.map(lambda x: x[:, :burn_in], window))
    future = jax.tree.map(lambda x: jnp.swapaxes(x[:, burn_in:], 0, 1), window)
    actions = jnp.swapaxes(future.action, 0, 1)
    prediction, imagined, memories = open_loop(dynamics, scales, future.observation[0], memory, actions)
    unit = scales.delta.reshape(1, 1, -1)
    change = (future.next_observation - future.observation) / unit
    outcome = dynamics.outcome(memories, future.observation, future.action, change)
    target = (future.next_observation - imagined[:-1]) / unit
    alive = future.valid * (1.0 - future.terminated)
    dead = future.valid * future.terminated
    count = jnp.maximum(jnp.sum(future.valid), 1.0)

    def average(x: Array, weights: Array) -> Array:
        return jnp.sum(x * weights) / count

    nll = average(mixture_nll(prediction, target, likelihood), future.valid)
    mean_error = average(jnp.mean(jnp.square(prediction.mean() - target), axis=-1), future.valid)
    reward_error = average(jnp.square(outcome.reward - future.reward), alive)
    terminal_error = average(jnp.square(outcome.terminal_reward - future.terminal_reward), dead)
    logit = outcome.continue_logit
    ending = average(jax.nn.softplus(-logit), alive) + average(jax.nn.softplus(logit), dead)
    loss = nll + mean_weight * mean_error + reward_error + terminal_error + ending
    weights = jnp.exp(prediction.log_weights)
    entropy = -jnp.sum(weights * prediction.log_weights, axis=-1)
    return loss, {
        "dynamics/nll": nll,
        "dynamics/mean_mse": mean_error,
        "dynamics/reward_mse": reward_error,
        "dynamics/continue_bce": ending,
        "dynamics/gate_entropy": average(entropy, future.valid),
    }


def open_loop_error(dynamics: Dynamics, scales: Scales, window: Window, *, burn_in: int) -> Float[Array, "time 2"]:
    """`mbdpg.dynamics.accuracy.errors_over_time` of the mixture's mean, over steps whose past is in the window."""
    memory = warm_memory(dynamics, jax.tree.map(lambda x: x[:, :burn_in], window))
    start = window.observation[:, burn_in]
    imagined = open_loop(dynamics, scales, start, memory, window.action[:, burn_in:])[1]
    truth, exists = window.next_observation[:, burn_in:], window.valid[:, burn_in:]
    return errors_over_time(imagined[1:], start, truth, exists)
