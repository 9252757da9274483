"""Measurements of MBDPG on episodes of its learned policy that it has never learned from."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from mbdpg.agents import objectives
from mbdpg.agents.mbdpg.config import Config
from mbdpg.agents.mbdpg.state import State
from mbdpg.dynamics.accuracy import DEPTHS, error_metrics
from mbdpg.dynamics.fitting import Window, open_loop_error, warm_memory
from mbdpg.dynamics.imagination import Trajectory, imagine
from mbdpg.dynamics.mixture import Memory
from mbdpg.interfaces import Metrics
from mbdpg.networks.policy import Policy

NEAR = 5
"""Imagined steps whose rewards are compared with those that were paid."""

OUTLYING = 5.0
"""An imagined observation entry beyond this many standard deviations counts as out of the data's range."""


def measure(config: Config, state: State, window: Window, realized_return: Float[Array, " batch"]) -> Metrics:
    """All instruments at once.

    Args:
        config: the agent's.
        state: the agent's.
        window: `burn_in` steps, then as many as the greatest depth, of evaluation episodes.
        realized_return: discounted return that followed the first step after the burn-in, NaN where unknown.
    """
    memory = warm_memory(state.average_dynamics, jax.tree.map(lambda x: x[:, : config.burn_in], window))
    now = window.observation[:, config.burn_in]
    value = objectives.clipped_value(state.critics(now, window.action[:, config.burn_in])) * state.return_scale
    imagined = _imagine(state, state.average_actor, now, memory, depth=max(DEPTHS), printed=False)
    steps = slice(config.burn_in, None)
    paid = state.real_reward(window)[:, steps]
    exists = window.valid[:, steps]
    near = exists[:, :NEAR]
    excess = jnp.sum((imagined.rewards[:NEAR].T - paid[:, :NEAR]) * near) / jnp.sum(near)
    ended = jnp.max(window.terminated[:, steps] * exists, axis=1)
    discounts = config.discount ** jnp.arange(max(DEPTHS), dtype=jnp.float32)
    whole = jnp.maximum(ended, exists[:, -1])  # a time limit cuts the others
    shares = whole / jnp.sum(whole)  # 0 gives NaN: nothing is known
    survival = imagined.survival()
    errors = open_loop_error(state.average_dynamics, state.scales, window, burn_in=config.burn_in)
    return (
        error_metrics(errors)
        | objectives.value_bias(value, realized_return)
        | {
            "dynamics/reward_bias": excess * state.return_scale,
            "dynamics/return_imagined": discounts @ (imagined.rewards * survival[:-1]) @ shares * state.return_scale,
            "dynamics/return_observed": shares @ (paid * exists) @ discounts * state.return_scale,
            "dynamics/survival_imagined": jnp.mean(survival[-1]),
            "dynamics/survival_observed": 1.0 - jnp.mean(ended),
            "dynamics/out_of_range": jnp.mean(jnp.abs(imagined.observations[1:]) > OUTLYING),
        }
        | {
            f"actor/grad_norm_k{depth:02d}": _gradient_norm(config, state, now, memory, depth)
            for depth in DEPTHS
            if depth <= config.horizon
        }
    )


def _gradient_norm(config: Config, state: State, start: Array, memory: Memory, depth: int) -> Array:
    """Norm of the derivative of E[Q(s_t, a_t)], t = depth, Q as the actor climbs it, by the actor's parameters."""
    printed = config.gradient == "eq19"

    def value(actor: Policy) -> Array:
        imagined = _imagine(state, actor, start, memory, depth=depth, printed=printed)
        seen = imagined.observations[-1]
        seen = jax.lax.stop_gradient(seen) if printed else seen
        return jnp.mean(objectives.climbed_value(state.critics(seen, imagined.actions[-1]), config.actor_value))

    return optax.tree.norm(jax.grad(value)(state.actor))


def _imagine(state: State, actor: Policy, start: Array, memory: Memory, *, depth: int, printed: bool) -> Trajectory:
    return imagine(
        state.average_dynamics, state.scales, actor, start, memory, horizon=depth, detach_policy_input=printed
    )
