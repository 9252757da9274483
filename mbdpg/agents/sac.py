"""Soft actor-critic with a learned temperature (Haarnoja et al. 2018b), on the networks that MBDPG has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from mbdpg.agents import objectives
from mbdpg.interfaces import Batch, EnvSpec, Metrics, Phase, Sampling, Statistics, require_settings
from mbdpg.networks.critic import Critics
from mbdpg.networks.normalizer import Normalizer, identity
from mbdpg.networks.optimizer import adam
from mbdpg.networks.policy import GaussianPolicy, Policy


@dataclass(frozen=True)
class Config:
    """Settings of SAC."""

    discount: float = 0.99
    """Discount factor gamma per environment step."""
    batch_size: int = 256
    """Transitions per update."""
    updates_per_step: float = 1.0
    """Updates of critics, actor and temperature per environment step."""
    learning_rate: float = 3e-4
    """Adam's step size for actor, critics and temperature."""
    target_update_rate: float = 0.005
    """Share of the online critics that the targets take over at each update (Polyak)."""
    entropy_per_action: float = -1.0
    """Entropy that the temperature aims at, per entry of the action (nats)."""
    initial_temperature: float = 1.0
    """Temperature alpha before the first update, in units of the return scale per nat."""
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
            positive=("batch_size", "updates_per_step", "learning_rate", "initial_temperature", "layers", "width"),
            at_most={"discount": 1, "target_update_rate": 1, "exploration_scatter": 1, "exploration_color": 2},
            signed=("entropy_per_action",),
        )


class State(eqx.Module):
    """Everything that learning changes."""

    actor: GaussianPolicy
    critics: Critics
    target_critics: Critics
    log_temperature: Float[Array, ""]
    actor_optimizer: Any
    critic_optimizer: Any
    temperature_optimizer: Any
    normalizer: Normalizer
    return_scale: Float[Array, ""]
    """Reward that counts as one unit of value."""


class SAC:
    """The agent; `update` is one step of critics, actor, temperature and targets."""

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
        actor = GaussianPolicy(o, a, widths, plain=c.plain, key=actor_key)
        critics = Critics(o, a, widths, plain=c.plain, key=critic_key)
        temperature = jnp.log(jnp.asarray(c.initial_temperature, jnp.float32))
        return State(
            actor=actor,
            critics=critics,
            target_critics=jax.tree.map(jnp.copy, critics),
            log_temperature=temperature,
            actor_optimizer=self._optimizer.init(actor),
            critic_optimizer=self._optimizer.init(critics),
            temperature_optimizer=self._optimizer.init(temperature),
            normalizer=identity(o, bounded=not c.plain),
            return_scale=jnp.ones(()),
        )

    def prepare(self, state: State, statistics: Statistics) -> State:
        """Take over the replay's scales."""
        if self.config.plain:
            return state
        normalizer = Normalizer(statistics.observation_mean, statistics.observation_std)
        return eqx.tree_at(lambda x: (x.normalizer, x.return_scale), state, (normalizer, statistics.return_scale))

    def policy(self, state: State) -> tuple[Policy, Normalizer]:
        """The center of the actor's Gaussian."""
        return state.actor.center, state.normalizer

    def behavior(self, state: State) -> tuple[GaussianPolicy, Normalizer, Array]:
        """The actor, whose noise has its own spread: the one here is 1."""
        return state.actor, state.normalizer, jnp.ones_like(state.return_scale)

    def update(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """One update from a batch of windows of one step."""
        batch = jax.tree.map(lambda x: x[:, 0], batch)
        observation, after = state.normalizer(batch.observation), state.normalizer(batch.next_observation)
        target_key, actor_key = jax.random.split(key)
        temperature = jnp.exp(state.log_temperature)

        next_action, next_density = state.actor.sample(after, key=target_key)
        next_value = objectives.clipped_value(state.target_critics(after, next_action)) - temperature * next_density
        target = objectives.temporal_difference_target(
            batch.reward / state.return_scale, batch.terminated, next_value, self.config.discount
        )

        def critic_loss(critics: Critics) -> tuple[Array, Array]:
            values = critics(observation, batch.action)
            return objectives.critic_loss(values, target, jnp.ones_like(target)), values

        (loss, values), gradient = jax.value_and_grad(critic_loss, has_aux=True)(state.critics)
        critics, critic_optimizer = self._step(state.critics, gradient, state.critic_optimizer)

        def actor_loss(actor: GaussianPolicy) -> tuple[Array, Array]:
            action, density = actor.sample(observation, key=actor_key)
            value = objectives.clipped_value(critics(observation, action))
            return jnp.mean(temperature * density - value), jnp.mean(density)

        (actor_value, density), gradient = jax.value_and_grad(actor_loss, has_aux=True)(state.actor)
        actor, actor_optimizer = self._step(state.actor, gradient, state.actor_optimizer)
        # The gradient of -log(temperature) (log pi + wanted entropy) is what there is of entropy beyond that wanted.
        surplus = -density - self.config.entropy_per_action * self.env.action_size
        log_temperature, temperature_optimizer = self._step(state.log_temperature, surplus, state.temperature_optimizer)

        return State(
            actor=actor,
            critics=critics,
            target_critics=optax.incremental_update(critics, state.target_critics, self.config.target_update_rate),
            log_temperature=log_temperature,
            actor_optimizer=actor_optimizer,
            critic_optimizer=critic_optimizer,
            temperature_optimizer=temperature_optimizer,
            normalizer=state.normalizer,
            return_scale=state.return_scale,
        ), {
            "critic/loss": loss,
            "critic/q_mean": jnp.mean(values) * state.return_scale,
            "critic/skipped": critic_optimizer.total_notfinite,
            "actor/objective": -actor_value,
            "actor/entropy": -density,
            "actor/temperature": temperature,
            "actor/skipped": actor_optimizer.total_notfinite,
        }

    def _step(self, parameters: Any, gradient: Any, optimizer_state: Any) -> tuple[Any, Any]:
        updates, optimizer_state = self._optimizer.update(gradient, optimizer_state)
        return optax.apply_updates(parameters, updates), optimizer_state

    @property
    def diagnosis(self) -> Sampling:
        """One step is enough: there is no model to unroll."""
        return Sampling(256, burn_in=0, length=1)

    def diagnose(self, state: State, batch: Batch, realized_return: Array) -> Metrics:
        """Q, which counts entropy too, against the return that followed."""
        values = state.critics(state.normalizer(batch.observation[:, 0]), batch.action[:, 0])
        value = objectives.clipped_value(values) * state.return_scale
        return objectives.value_bias(value, realized_return)
