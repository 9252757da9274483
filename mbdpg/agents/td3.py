"""Twin delayed deterministic policy gradient (Fujimoto et al. 2018), on the networks that MBDPG has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mbdpg.agents import objectives
from mbdpg.interfaces import Batch, EnvSpec, Metrics, Phase, Sampling, Statistics, require_settings
from mbdpg.networks.critic import Critics
from mbdpg.networks.normalizer import Normalizer, identity
from mbdpg.networks.optimizer import adam
from mbdpg.networks.policy import Policy


@dataclass(frozen=True)
class Config:
    """Settings of TD3."""

    discount: float = 0.99
    """Discount factor gamma per environment step."""
    batch_size: int = 256
    """Transitions per update."""
    updates_per_step: float = 1.0
    """Critic updates per environment step."""
    policy_delay: int = 2
    """Critic updates per actor and target update."""
    learning_rate: float = 3e-4
    """Adam's step size for actor and critics."""
    target_update_rate: float = 0.005
    """Share of the online networks that the targets take over at each of their updates (Polyak)."""
    target_noise: float = 0.2
    """Standard deviation of the noise on target actions."""
    target_noise_clip: float = 0.5
    """Bound of that noise."""
    exploration_std: float = 0.1
    """Standard deviation of the Gaussian behavior policy, its mean over episodes."""
    exploration_color: float = 0.0
    """Noise of the behavior policy has power 1/f^color: 0 is white, 1 pink, correlated over many steps."""
    exploration_scatter: float = 0.0
    """Every episode's spread is drawn uniformly from within this share of its mean, from none to twice as much at 1."""
    random_steps: int = 4000
    """Environment steps with uniformly random actions before learning starts."""
    layers: int = 3
    """Dense layers of every network."""
    width: int = 256
    """Width of each."""
    plain: bool = False
    """Networks of ReLU without LayerNorm, on observations and rewards as they are."""

    def __post_init__(self) -> None:
        require_settings(
            self,
            positive=("batch_size", "updates_per_step", "policy_delay", "learning_rate", "layers", "width"),
            at_most={"discount": 1, "target_update_rate": 1, "exploration_scatter": 1, "exploration_color": 2},
        )


class State(eqx.Module):
    """Everything that learning changes."""

    actor: Policy
    critics: Critics
    target_actor: Policy
    target_critics: Critics
    actor_optimizer: Any
    critic_optimizer: Any
    normalizer: Normalizer
    return_scale: Float[Array, ""]
    """Reward that counts as one unit of value."""
    updates: Int[Array, ""]
    """Critic updates so far."""


class TD3:
    """The agent; `update` is one critic step and, every `policy_delay`-th time, one actor and target step."""

    def __init__(self, config: Config, env: EnvSpec):
        self.config = config
        self.env = env
        self._optimizer = adam(config.learning_rate)
        sampling = Sampling(config.batch_size, burn_in=0, length=1)
        self.phases = (Phase("improving", config.updates_per_step, sampling=sampling, update=self.update),)

    def init(self, *, key: PRNGKeyArray) -> State:
        """Fresh networks; targets equal to what they follow."""
        c, o, a = self.config, self.env.observation_size, self.env.action_size
        widths = (c.width,) * c.layers
        actor_key, critic_key = jax.random.split(key)
        actor = Policy(o, a, widths, plain=c.plain, key=actor_key)
        critics = Critics(o, a, widths, plain=c.plain, key=critic_key)
        return State(
            actor=actor,
            critics=critics,
            target_actor=jax.tree.map(jnp.copy, actor),
            target_critics=jax.tree.map(jnp.copy, critics),
            actor_optimizer=self._optimizer.init(actor),
            critic_optimizer=self._optimizer.init(critics),
            normalizer=identity(o, bounded=not c.plain),
            return_scale=jnp.ones(()),
            updates=jnp.zeros((), jnp.int32),
        )

    def prepare(self, state: State, statistics: Statistics) -> State:
        """Take over the replay's scales."""
        if self.config.plain:
            return state
        normalizer = Normalizer(statistics.observation_mean, statistics.observation_std)
        return eqx.tree_at(lambda x: (x.normalizer, x.return_scale), state, (normalizer, statistics.return_scale))

    def policy(self, state: State) -> tuple[Policy, Normalizer]:
        """The actor."""
        return state.actor, state.normalizer

    def behavior(self, state: State) -> tuple[Policy, Normalizer, Array]:
        """The actor, with constant noise."""
        return state.actor, state.normalizer, jnp.full_like(state.return_scale, self.config.exploration_std)

    def update(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """One update from a batch of windows of one step."""
        c = self.config
        batch = jax.tree.map(lambda x: x[:, 0], batch)
        observation, after = state.normalizer(batch.observation), state.normalizer(batch.next_observation)
        next_action = state.target_actor(after)
        next_action = objectives.smoothed_action(next_action, c.target_noise, c.target_noise_clip, key=key)
        next_values = state.target_critics(after, next_action)
        target = objectives.temporal_difference_target(
            batch.reward / state.return_scale, batch.terminated, objectives.clipped_value(next_values), c.discount
        )

        def critic_loss(critics: Critics) -> tuple[Array, Array]:
            values = critics(observation, batch.action)
            return objectives.critic_loss(values, target, jnp.ones_like(target)), values

        (loss, values), gradient = jax.value_and_grad(critic_loss, has_aux=True)(state.critics)
        updates, critic_optimizer = self._optimizer.update(gradient, state.critic_optimizer)
        critics = optax.apply_updates(state.critics, updates)
        state = eqx.tree_at(
            lambda x: (x.critics, x.critic_optimizer, x.updates),
            state,
            (critics, critic_optimizer, state.updates + 1),
        )
        delayed = jnp.mod(state.updates, c.policy_delay) == 0
        state, objective = jax.lax.cond(
            delayed, lambda s: self._improve(s, observation), lambda s: (s, jnp.zeros(())), state
        )
        return state, {
            "critic/loss": loss,
            "critic/q_mean": jnp.mean(values) * state.return_scale,
            "critic/skipped": critic_optimizer.total_notfinite,
            "actor/objective": objective * c.policy_delay,
            "actor/skipped": state.actor_optimizer.total_notfinite,
        }

    def _improve(self, state: State, observation: Array) -> tuple[State, Array]:
        """Ascend Q_1(s, mu(s)) and let the targets follow."""

        def actor_loss(actor: Policy) -> Array:
            return -jnp.mean(state.critics(observation, actor(observation))[0])

        loss, gradient = jax.value_and_grad(actor_loss)(state.actor)
        updates, actor_optimizer = self._optimizer.update(gradient, state.actor_optimizer)
        actor = optax.apply_updates(state.actor, updates)
        targets = optax.incremental_update(
            (state.critics, actor), (state.target_critics, state.target_actor), self.config.target_update_rate
        )
        state = eqx.tree_at(
            lambda x: (x.actor, x.actor_optimizer, x.target_critics, x.target_actor),
            state,
            (actor, actor_optimizer, *targets),
        )
        return state, -loss

    @property
    def diagnosis(self) -> Sampling:
        """One step is enough: there is no model to unroll."""
        return Sampling(256, burn_in=0, length=1)

    def diagnose(self, state: State, batch: Batch, realized_return: Array) -> Metrics:
        """Q against the return that followed."""
        values = state.critics(state.normalizer(batch.observation[:, 0]), batch.action[:, 0])
        value = objectives.clipped_value(values) * state.return_scale
        return objectives.value_bias(value, realized_return)
