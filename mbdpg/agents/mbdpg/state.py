"""What MBDPG's learning changes, and how it begins."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mbdpg.agents.mbdpg.config import Config
from mbdpg.dynamics.fitting import Window
from mbdpg.dynamics.imagination import Ring, Start
from mbdpg.dynamics.mixture import MixtureDynamics, Scales
from mbdpg.interfaces import Batch, EnvSpec
from mbdpg.networks.critic import Critics
from mbdpg.networks.normalizer import Normalizer, identity
from mbdpg.networks.optimizer import adam
from mbdpg.networks.policy import Policy


class State(eqx.Module):
    """Everything that learning changes."""

    dynamics: MixtureDynamics
    average_dynamics: MixtureDynamics
    """Running average of the dynamics' parameters, whose newest terms weigh most: what imagines."""
    actor: Policy
    average_actor: Policy
    """The same of the actor's: what is evaluated and saved."""
    critics: Critics
    target_actor: Policy
    target_critics: Critics
    dynamics_optimizer: Any
    actor_optimizer: Any
    critic_optimizer: Any
    normalizer: Normalizer
    scales: Scales
    return_scale: Float[Array, ""]
    """Reward that counts as one unit of value."""
    imagined: Ring
    """Of `Start`s: where imagination ended and may go on."""
    progress: Float[Array, ""]
    """Of the return, from a random policy's (0) to the reference return (1)."""
    updates: Int[Array, ""]
    """Updates of the critics so far."""

    def window(self, batch: Batch) -> Window:
        """A batch in the units that networks see."""
        terminated = batch.terminated
        value = batch.reward / self.return_scale
        return Window(
            observation=self.normalizer(batch.observation),
            action=batch.action,
            next_observation=self.normalizer(batch.next_observation),
            reward=value * (1.0 - terminated) / self.scales.reward,
            terminal_reward=value * terminated / self.scales.terminal_reward,
            terminated=terminated,
            valid=batch.valid,
        )

    def real_reward(self, window: Window) -> Float[Array, "*batch"]:
        """In units of value."""
        return window.reward * self.scales.reward + window.terminal_reward * self.scales.terminal_reward

    def following(self, first: float, final: float) -> Float[Array, ""]:
        """What goes from `first` to `final` with the return (Section 4.3.2)."""
        return first + (final - first) * self.progress


class Optimizers(NamedTuple):
    """One per network."""

    dynamics: optax.GradientTransformation
    actor: optax.GradientTransformation
    critic: optax.GradientTransformation


def optimizers(config: Config) -> Optimizers:
    """Adam behind a global-norm clip for each."""
    return Optimizers(
        dynamics=adam(config.dynamics_learning_rate, clip=config.dynamics_clip),
        actor=adam(config.actor_learning_rate, clip=config.actor_clip),
        critic=adam(config.critic_learning_rate, clip=config.critic_clip),
    )


def initial_state(config: Config, env: EnvSpec, optimizers: Optimizers, *, key: PRNGKeyArray) -> State:
    """Fresh networks; targets and averages equal to what they follow."""
    o, a, widths = env.observation_size, env.action_size, (config.width,) * 3
    dynamics_key, actor_key, critic_key = jax.random.split(key, 3)
    dynamics = MixtureDynamics(o, a, gaussians=config.gaussians, memory=config.memory, widths=widths, key=dynamics_key)
    actor = Policy(o, a, widths, key=actor_key)
    critics = Critics(o, a, widths, key=critic_key)
    one, zero, slots = jnp.ones(()), jnp.zeros(()), 8 * config.batch_size
    return State(
        dynamics=dynamics,
        average_dynamics=jax.tree.map(jnp.copy, dynamics),
        actor=actor,
        average_actor=jax.tree.map(jnp.copy, actor),
        critics=critics,
        target_actor=jax.tree.map(jnp.copy, actor),
        target_critics=jax.tree.map(jnp.copy, critics),
        dynamics_optimizer=optimizers.dynamics.init(dynamics),
        actor_optimizer=optimizers.actor.init(actor),
        critic_optimizer=optimizers.critic.init(critics),
        normalizer=identity(o),
        scales=Scales(jnp.ones(o), one, one),
        return_scale=one,
        imagined=Ring.empty(slots, Start(jnp.zeros(o), dynamics.initial_memory(()), zero, zero)),
        progress=zero,
        updates=jnp.zeros((), jnp.int32),
    )
