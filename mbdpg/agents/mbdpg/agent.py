"""The agent: `fit` learns the dynamics, `clone` from demonstrations, `improve` critics and actor, `ground` critics."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, PRNGKeyArray

from mbdpg.agents import objectives
from mbdpg.agents.mbdpg import instruments
from mbdpg.agents.mbdpg.config import Config
from mbdpg.agents.mbdpg.state import State, initial_state, optimizers
from mbdpg.dynamics.accuracy import DEPTHS
from mbdpg.dynamics.fitting import Window, dynamics_loss, warm_memory
from mbdpg.dynamics.imagination import Ring, Start, Trajectory, imagine
from mbdpg.dynamics.mixture import Scales
from mbdpg.interfaces import Batch, EnvSpec, Metrics, Phase, Sampling, Statistics
from mbdpg.networks.critic import Critics
from mbdpg.networks.mlp import Slopes
from mbdpg.networks.normalizer import Normalizer
from mbdpg.networks.policy import Policy


class MBDPG:
    """Algorithm 1: `clone` is line 3, `fit` line 7 and `improve` lines 11 to 14; `ground` is ours."""

    def __init__(self, config: Config, env: EnvSpec):
        self.config = config
        self.env = env
        self._optimizers = optimizers(config)
        c = config
        fitted = Sampling(c.fit_batch_size, c.burn_in, c.fit_length)
        cloned = Sampling(c.batch_size, burn_in=0, length=1, demonstrated=True)
        recent = Sampling(c.batch_size, 0, 1, newest=c.recent_steps, terminations=c.recent_terminations)
        improved = recent._replace(burn_in=c.burn_in)
        grounded = recent._replace(batch_size=c.grounding_batch_size, length=c.grounding_length)
        fitting = Phase("fitting", c.fits_per_step, fitted, c.pretraining_fits, self.fit)
        self.phases = (
            Phase("cloning", 0.0, cloned, c.cloning_updates, self.clone),
            *([fitting] if c.horizon > 0 else []),
            Phase("improving", c.updates_per_step, improved, 0, self.improve),
            Phase("grounding", c.groundings_per_step, grounded, 0, self.ground),
        )

    def init(self, *, key: PRNGKeyArray) -> State:
        """Fresh networks; targets equal to what they follow."""
        return initial_state(self.config, self.env, self._optimizers, key=key)

    def prepare(self, state: State, statistics: Statistics) -> State:
        """Take over the replay's scales and how far the return is."""
        return eqx.tree_at(
            lambda x: (x.normalizer, x.scales, x.return_scale, x.progress),
            state,
            (
                Normalizer(statistics.observation_mean, statistics.observation_std),
                Scales(
                    statistics.delta_std / statistics.observation_std,
                    statistics.reward_std / statistics.return_scale,
                    statistics.terminal_reward_scale / statistics.return_scale,
                ),
                statistics.return_scale,
                statistics.progress,
            ),
        )

    def policy(self, state: State) -> tuple[Policy, Normalizer]:
        """The running average of the actor, which wanders less than the actor does from update to update."""
        return state.average_actor, state.normalizer

    def behavior(self, state: State) -> tuple[Policy, Normalizer, Array]:
        """The actor mu itself, so that the replay shows what the newest update does, and the spread of pi around it."""
        std = state.following(self.config.exploration_std, self.config.final_exploration_std)
        return state.actor, state.normalizer, std

    def fit(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """One update of the dynamics (Eq. 11)."""
        del key  # the loss is deterministic
        c = self.config
        gradient, metrics = jax.grad(dynamics_loss, has_aux=True)(
            state.dynamics,
            state.scales,
            state.window(batch),
            burn_in=c.burn_in,
            likelihood=c.likelihood,
            mean_weight=c.mean_weight,
        )
        updates, optimizer_state = self._optimizers.dynamics.update(gradient, state.dynamics_optimizer)
        dynamics = optax.apply_updates(state.dynamics, updates)
        metrics |= {
            "dynamics/grad_norm": optax.tree.norm(gradient),
            "dynamics/skipped": optimizer_state.total_notfinite,
        }
        average = self._average(state.average_dynamics, dynamics, state.dynamics_optimizer)
        return eqx.tree_at(
            lambda x: (x.dynamics, x.average_dynamics, x.dynamics_optimizer),
            state,
            (dynamics, average, optimizer_state),
        ), metrics

    def clone(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """Learn critics (Eq. 14) and actor (Eq. 15) from a batch of demonstrated transitions."""
        window = state.window(batch)
        state, _ = self.ground(state, batch, key=key)
        observation, action = window.observation[:, -1], window.action[:, -1]

        def loss(actor: Policy) -> Array:
            return objectives.cloning_loss(actor(observation), action)

        value, gradient = jax.value_and_grad(loss)(state.actor)
        return self._step_actor(state, gradient), {"actor/cloning_loss": value}

    def improve(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """One update of the critics (Eq. 16, 17) and of the actor (Eq. 18) on trajectories imagined after a batch."""
        c = self.config
        window = state.window(batch)
        start_key, target_key, model_key = jax.random.split(key, 3)
        start = self._start(state, window, key=start_key)
        real = window.observation[:, -1], window.action[:, -1]
        gradient, (imagined, slopes, metrics) = jax.grad(self._actor_loss, has_aux=True)(
            state.actor, state, real, start, model_key
        )
        targets = self._targets(state, window, start, imagined, key=target_key)
        weights = imagined.survival()[:-1] * start.weight[None]

        def loss(values: Array) -> Array:
            total = self._critic_loss(state, values[:, 0], targets[0], jnp.ones_like(targets[0]))
            return total + c.imagined_weight * self._critic_loss(state, values[:, 1:-1], targets[1:], weights)

        values = slopes.output.reshape(-1, c.horizon + 2, *start.weight.shape)
        critic_loss, errors = jax.value_and_grad(loss)(values)
        critic_gradient = state.critics.weighted_gradient(slopes, errors)
        state = self._step_actor(self._step_critics(state, critic_gradient), gradient)
        if c.imagination_ratio > 0.0:
            state = eqx.tree_at(lambda x: x.imagined, state, self._store(state.imagined, start, imagined))
        return state, metrics | {
            "critic/loss": critic_loss,
            "critic/q_mean": jnp.mean(values[:, 0]) * state.return_scale,
            "critic/grad_norm": optax.tree.norm(critic_gradient),
            "critic/skipped": state.critic_optimizer.total_notfinite,
            "actor/grad_norm": optax.tree.norm(gradient),
            "actor/skipped": state.actor_optimizer.total_notfinite,
        }

    def ground(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """One update of the critics on real steps alone (Eq. 14 with targets and clipping), by returns over several.

        A return follows what was done while it resembles what the policy does, and is cut there without correction.
        """
        steps = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), state.window(batch))
        values = self._target_value(state, steps.next_observation, key=key)
        after = jax.tree.map(lambda x: x[1:], steps)
        alike = objectives.likeness(after.action, state.actor(after.observation), self.config.grounding_tolerance)
        # Whether to follow the next step; after the last there is none.
        trace = jnp.concatenate([after.valid * alike, jnp.zeros_like(steps.valid[:1])])
        rewards, continues = state.real_reward(steps), 1.0 - steps.terminated
        targets = objectives.expanded_values(rewards, continues, values, self.config.discount, trace)

        def loss(critics: Critics) -> Array:
            return self._critic_loss(state, critics(steps.observation, steps.action), targets, steps.valid)

        value, gradient = jax.value_and_grad(loss)(state.critics)
        steps_after = jnp.maximum(jnp.sum(after.valid), 1.0)
        metrics = {"critic/grounding_loss": value, "critic/grounding_trace": jnp.sum(trace) / steps_after}
        return self._step_critics(state, gradient), metrics

    def _target_value(self, state: State, observation: Array, *, key: PRNGKeyArray) -> Array:
        """Clipped value of the target policy's action, smoothed as in TD3."""
        action = objectives.smoothed_action(state.target_actor(observation), self.config.target_noise, 0.5, key=key)
        return objectives.clipped_value(state.target_critics(observation, action))

    def _critic_loss(self, state: State, values: Array, targets: Array, weights: Array) -> Array:
        share = state.progress  # early, large errors are news and not noise (results/notebook.md, 84)
        return objectives.critic_loss(values, targets, weights, huber_delta=self.config.huber_delta, huber_share=share)

    def _step_critics(self, state: State, gradient: Critics) -> State:
        """Step the critics, then let the targets follow every C-th time."""
        c = self.config
        updates, optimizer_state = self._optimizers.critic.update(gradient, state.critic_optimizer)
        critics = optax.apply_updates(state.critics, updates)
        count = state.updates + 1
        rate = jnp.where(jnp.mod(count, c.target_update_every) == 0, c.target_update_rate, 0.0)
        targets = optax.incremental_update((critics, state.actor), (state.target_critics, state.target_actor), rate)
        return eqx.tree_at(
            lambda x: (x.critics, x.critic_optimizer, x.target_critics, x.target_actor, x.updates),
            state,
            (critics, optimizer_state, *targets, count),
        )

    def _step_actor(self, state: State, gradient: Policy) -> State:
        updates, optimizer_state = self._optimizers.actor.update(gradient, state.actor_optimizer)
        actor = optax.apply_updates(state.actor, updates)
        average = self._average(state.average_actor, actor, state.actor_optimizer)
        return eqx.tree_at(
            lambda x: (x.actor, x.average_actor, x.actor_optimizer), state, (actor, average, optimizer_state)
        )

    def _average(self, average: Any, newest: Any, optimizer: Any) -> Any:
        """Move to the newest so that weights fade over `average_share` of the updates that the optimizer counted."""
        before = optax.tree.get(optimizer, "count").astype(jnp.float32)
        return optax.incremental_update(newest, average, 1.0 / (1.0 + self.config.average_share * before))

    def _start(self, state: State, window: Window, *, key: PRNGKeyArray) -> Start:
        """Where imagination starts: after each real transition, or for a share of them in the imagination buffer."""
        memory = warm_memory(state.average_dynamics, window)
        memory = jax.lax.stop_gradient(memory)
        alive = 1.0 - window.terminated[:, -1]
        real = Start(window.next_observation[:, -1], memory, alive, jnp.zeros_like(alive))
        if self.config.imagination_ratio == 0.0:
            return real
        batch = alive.shape[0]
        model = state.imagined.sample(batch, key=key)
        use = (jnp.arange(batch) < round(self.config.imagination_ratio * batch)) & (model.weight > 0.0)
        return jax.tree.map(lambda m, r: jnp.where(use.reshape((-1,) + (1,) * (r.ndim - 1)), m, r), model, real)

    def _actor_loss(
        self, actor: Policy, state: State, real: tuple[Array, Array], start: Start, key: PRNGKeyArray
    ) -> tuple[Array, tuple[Trajectory, Slopes, Metrics]]:
        """-J of Eq. 18 in units of the values' size; its derivative is Eq. 19 where `gradient` says so.

        Beside it, for the critics to learn from: the trajectories, and the critics' slopes at the observations and
        actions `real` and then along those.
        """
        c = self.config
        printed = c.gradient == "eq19"
        imagined = imagine(
            state.average_dynamics,
            state.scales,
            actor,
            start.observation,
            start.memory,
            horizon=c.horizon,
            detach_policy_input=printed,
            key=key if c.planning == "stochastic" else None,
        )
        seen = jax.lax.stop_gradient(imagined.observations) if printed else imagined.observations
        # One call for real and imagined steps: each call packs all weights anew.
        observations = jnp.concatenate([real[0][None], seen])
        actions = jnp.concatenate([real[1][None], imagined.actions])
        values, slopes = state.critics.with_slopes(observations, actions)
        values = objectives.climbed_value(values[:, 1 + c.first_value :], c.actor_value)
        values = values if c.terminal_value else jnp.zeros_like(values)
        survival = imagined.survival()
        survival = jax.lax.stop_gradient(survival) if printed else survival
        beta = state.following(c.beta, c.final_beta)
        objective = objectives.policy_objective(
            imagined.rewards, values, survival, discount=c.discount, beta=beta, reward_weights=c.reward_weights
        )
        count = jnp.maximum(jnp.sum(start.weight), 1.0)
        mean = jnp.sum(objective * start.weight) / count
        size = jax.lax.stop_gradient(jnp.maximum(jnp.sum(jnp.abs(objective) * start.weight) / count, 1.0))
        saturation = jnp.sum(jnp.mean(jnp.square(actor.mlp(start.observation)), axis=-1) * start.weight) / count
        metrics = {
            "actor/objective": mean,
            "actor/saturation": saturation,
            "actor/survival": jnp.mean(survival[-1]),
            "actor/beta": beta,
        }
        return c.saturation_penalty * saturation - mean / size, (imagined, slopes, metrics)

    def _targets(self, state: State, window: Window, start: Start, imagined: Trajectory, *, key: PRNGKeyArray) -> Array:
        """What the critics are taught at the real transitions, then along the imagined ones: shape (H + 1, batch)."""
        c = self.config
        noise_key, real_key = jax.random.split(key)
        # With trace 1 no value but the last is read.
        seen = imagined.observations if c.trace < 1.0 else imagined.observations[-1:]
        values = self._target_value(state, seen, key=noise_key)
        values = jnp.broadcast_to(values, imagined.observations.shape[:-1])
        trace = jnp.full_like(values, c.trace)
        if c.imagination_ratio > 0.0:  # where imagination went on from elsewhere, the transition has one step
            elsewhere = start.depth > 0.0
            one_step = self._target_value(state, window.next_observation[:, -1], key=real_key)
            values = values.at[0].set(jnp.where(elsewhere, one_step, values[0]))
            trace = trace.at[0].set(jnp.where(elsewhere, 0.0, trace[0]))
        rewards = jnp.concatenate([state.real_reward(window)[:, -1:].T, imagined.rewards])
        continues = jnp.concatenate([1.0 - window.terminated[:, -1:].T, imagined.continues])
        return objectives.expanded_values(rewards, continues, values, c.discount, trace)

    def _store(self, ring: Ring, start: Start, imagined: Trajectory) -> Ring:
        """Keep where imagination ended, with weight 0 (nothing starts there) if it went too deep."""
        depth = start.depth + self.config.horizon
        shallow = depth <= self.config.imagination_depth
        weight = jnp.where(shallow, imagined.survival()[-1] * start.weight, 0.0)
        return ring.add(Start(imagined.observations[-1], imagined.memory, weight, depth))

    @property
    def diagnosis(self) -> Sampling:
        """Windows long enough for the deepest open-loop error."""
        return Sampling(256, self.config.burn_in, max(DEPTHS))

    def diagnose(self, state: State, batch: Batch, realized_return: Array) -> Metrics:
        """Open-loop error, Q and survival against what happened, gradient norm per imagined depth."""
        window = state.window(batch)
        metrics = instruments.measure(self.config, state, window, realized_return)
        known = self.config.horizon > 0  # else the dynamics are never trained
        return {name: value for name, value in metrics.items() if known or not name.startswith("dynamics/")}
