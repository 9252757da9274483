"""Model-based policy optimization (Janner et al. 2019): SAC on short rollouts of an ensemble, begun in real states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mbdpg.agents import sac
from mbdpg.dynamics.accuracy import DEPTHS, error_metrics
from mbdpg.dynamics.ensemble import Units, open_loop_error, predict
from mbdpg.dynamics.imagination import Ring
from mbdpg.dynamics.termination import RULES, known_rule
from mbdpg.dynamics.world import Fitting, World
from mbdpg.interfaces import Batch, EnvSpec, Metrics, Phase, Sampling, Statistics, require, require_settings
from mbdpg.networks.normalizer import Normalizer
from mbdpg.networks.policy import GaussianPolicy, Policy


@dataclass(frozen=True)
class Config(sac.Config):
    """Settings of MBPO: SAC's, and those of the world that it learns."""

    updates_per_step: float = 5.0
    """Updates of critics, actor and temperature per environment step."""
    real_share: float = 0.05
    """Share of real transitions in every batch of SAC's."""
    rollouts_per_step: int = 400
    """Imagined rollouts begun per environment step."""
    imagine_every: int = 250
    """Environment steps between two times that rollouts are imagined, many at once."""
    retained_steps: int = 1000
    """Environment steps whose rollouts are kept."""
    rollout_length: int = 1
    """Steps of a rollout at first."""
    final_rollout_length: int = 1
    """And at last."""
    lengthen_from: int = 20_000
    """Environment steps after which rollouts grow, linearly."""
    lengthen_until: int = 150_000
    """Environment steps after which they have their final length."""
    termination: Literal["learned", "known"] = "learned"
    """How rollouts end: as the ensemble has learned, or by the simulator's own rule, an oracle known for some tasks."""
    members: int = 7
    """Networks of the ensemble."""
    elites: int = 5
    """Those with the least held-out error, which alone are rolled out."""
    dynamics_width: int = 200
    """Width of each of their four hidden layers."""
    dynamics_learning_rate: float = 1e-3
    """Adam's step size for the ensemble."""
    weight_decay: float = 5e-5
    """Weight of half the ensemble's squared weights in its loss."""
    fits_per_step: float = 1.0
    """Updates of the ensemble per environment step."""
    pretraining_fits: int = 2000
    """Updates of the ensemble when the random steps are over."""
    fit_batch_size: int = 256
    """Transitions per update and member, drawn anew for each."""

    def __post_init__(self) -> None:
        learned = ("batch_size", "updates_per_step", "learning_rate", "initial_temperature", "layers", "width")
        imagined = ("rollouts_per_step", "imagine_every", "retained_steps", "rollout_length", "final_rollout_length")
        fitted = ("members", "elites", "dynamics_width", "dynamics_learning_rate", "fit_batch_size")
        shares = ("discount", "target_update_rate", "exploration_scatter", "real_share")
        require_settings(
            self,
            positive=(*learned, *imagined, *fitted),
            at_most=dict.fromkeys(shares, 1.0) | {"exploration_color": 2.0},
            signed=("entropy_per_action",),
        )
        few = f"--elites is {self.elites}, expected at most as many as --members, {self.members}"
        require(self.elites <= self.members, few)
        require(
            self.lengthen_from < self.lengthen_until,
            f"--lengthen-from is {self.lengthen_from}, expected less than --lengthen-until, {self.lengthen_until}",
        )


class Transition(eqx.Module):
    """One imagined step in raw units."""

    observation: Float[Array, "*batch observation"]
    action: Float[Array, "*batch action"]
    reward: Float[Array, "*batch"]
    next_observation: Float[Array, "*batch observation"]
    terminated: Float[Array, "*batch"]


class State(eqx.Module):
    """Everything that learning changes."""

    soft: sac.State
    """SAC's."""
    world: World
    imagined: Ring
    """Of `Transition`s."""
    rollout_length: Int[Array, ""]


class MBPO:
    """The agent: the ensemble is fitted, judged on held-out steps and rolled out; SAC learns from what it imagines."""

    def __init__(self, config: Config, env: EnvSpec):
        """Build it.

        Raises:
            UserError: the rule by which episodes end is said to be known, and is not.
        """
        c = self.config = config
        self.env = env
        self._sac = sac.SAC(c, env)
        self._rule = RULES[known_rule(env)] if c.termination == "known" else None
        rates = (c.dynamics_learning_rate, c.weight_decay)
        self._fitting = Fitting(c.members, c.dynamics_width, *rates, c.fit_batch_size, judged=True)
        self._real = min(round(c.real_share * c.batch_size), c.batch_size)
        # As many for every elite.
        self._rollouts = c.elites * max(1, round(c.rollouts_per_step * c.imagine_every / c.elites))
        steps, judging = self._fitting.sampling, self._fitting.judging
        starts, real = (Sampling(size, burn_in=0, length=1) for size in (self._rollouts, max(self._real, 1)))
        every = 1.0 / c.imagine_every
        self.phases = (
            Phase("fitting", c.fits_per_step, sampling=steps, first_updates=c.pretraining_fits, update=self.fit),
            Phase("judging", every, sampling=judging, first_updates=1, update=self.judge),
            Phase("imagining", every, sampling=starts, first_updates=1, update=self.imagine),
            Phase("improving", c.updates_per_step, sampling=real, update=self.improve),
        )

    def init(self, *, key: PRNGKeyArray) -> State:
        """Fresh networks and nothing imagined."""
        c, o, a = self.config, self.env.observation_size, self.env.action_size
        soft_key, world_key = jax.random.split(key)
        nothing = jnp.zeros(())
        slots = self._rollouts * max(1, c.retained_steps // c.imagine_every)
        return State(
            soft=self._sac.init(key=soft_key),
            world=self._fitting.init(self.env, key=world_key),
            imagined=Ring.empty(slots, Transition(jnp.zeros(o), jnp.zeros(a), nothing, jnp.zeros(o), nothing)),
            rollout_length=jnp.asarray(c.rollout_length, jnp.int32),
        )

    def prepare(self, state: State, statistics: Statistics) -> State:
        """Take over the replay's scales, and the length of rollouts that belongs to its size."""
        c = self.config
        way = jnp.clip((statistics.steps - c.lengthen_from) / (c.lengthen_until - c.lengthen_from), 0.0, 1.0)
        length = c.rollout_length + way * (c.final_rollout_length - c.rollout_length)
        return eqx.tree_at(
            lambda x: (x.soft, x.world.units, x.rollout_length),
            state,
            (self._sac.prepare(state.soft, statistics), Units.of(statistics), length.astype(jnp.int32)),
        )

    def policy(self, state: State) -> tuple[Policy, Normalizer]:
        """SAC's."""
        return self._sac.policy(state.soft)

    def behavior(self, state: State) -> tuple[GaussianPolicy, Normalizer, Array]:
        """SAC's."""
        return self._sac.behavior(state.soft)

    def fit(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """One update of the ensemble."""
        del key
        world, metrics = self._fitting.fit(state.world, batch)
        return eqx.tree_at(lambda x: x.world, state, world), metrics

    def judge(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """Find out which members are the elites."""
        del key
        world, metrics = self._fitting.judge(state.world, batch)
        return eqx.tree_at(lambda x: x.world, state, world), metrics

    def imagine(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """Roll the actor out in the elites from real states, and keep one step of each rollout, all equally likely.

        In the place of one that ends another goes on, from where a third began.
        """
        start = batch.observation[:, 0]
        elites = state.world.elites(self.config.elites)
        roll_key, keep_key = jax.random.split(key)
        wanted = jax.random.randint(keep_key, start.shape[:1], 0, state.rollout_length)

        def step(t: Array, carry: tuple[Array, Transition]) -> tuple[Array, Transition]:
            observation, kept = carry
            action_key, elite_key, model_key, end_key = jax.random.split(jax.random.fold_in(roll_key, t), 4)
            action, _ = state.soft.actor.sample(state.soft.normalizer(observation), key=action_key)
            # The rows are in no order, so that blocks of them for each elite are as good as an elite for each row.
            ensemble = state.world.ensemble.chosen(jax.random.permutation(elite_key, elites))
            blocks = (x.reshape(self.config.elites, -1, x.shape[-1]) for x in (observation, action))
            imagined = predict(ensemble, state.world.units, *blocks, key=model_key)
            after, reward, terminal_reward, continues = (x.reshape(start.shape[0], *x.shape[2:]) for x in imagined)
            ends = ~self._rule(after) if self._rule else jax.random.uniform(end_key, continues.shape) > continues
            reward = jnp.where(ends, terminal_reward, reward)
            new = Transition(observation, action, reward, after, ends.astype(jnp.float32))
            now = wanted == t
            kept = jax.tree.map(lambda n, k: jnp.where(now.reshape(-1, *[1] * (n.ndim - 1)), n, k), new, kept)
            # Not where it began itself: what is about to end there would be kept far more often than it happens.
            return jnp.where(ends[:, None], jnp.roll(start, t + 1, axis=0), after), kept

        nothing = jax.tree.map(lambda x: jnp.zeros((start.shape[0], *x.shape[1:])), state.imagined.rows)
        _, kept = jax.lax.fori_loop(0, state.rollout_length, step, (start, nothing))
        metrics = {"dynamics/rollout_length": state.rollout_length}
        return eqx.tree_at(lambda x: x.imagined, state, state.imagined.add(kept)), metrics

    def improve(self, state: State, batch: Batch, *, key: PRNGKeyArray) -> tuple[State, Metrics]:
        """One update of SAC from real and imagined transitions."""
        draw_key, update_key = jax.random.split(key)
        t: Transition = state.imagined.sample(self.config.batch_size - self._real, key=draw_key)
        imagined = Batch(t.observation, t.action, t.reward, t.next_observation, t.terminated, jnp.ones_like(t.reward))
        mixed = jax.tree.map(lambda r, i: jnp.concatenate([r[: self._real], i[:, None]]), batch, imagined)
        soft, metrics = self._sac.update(state.soft, mixed, key=update_key)
        return eqx.tree_at(lambda x: x.soft, state, soft), metrics

    @property
    def diagnosis(self) -> Sampling:
        """Windows long enough for the deepest open-loop error."""
        return Sampling(256, burn_in=0, length=max(DEPTHS))

    def diagnose(self, state: State, batch: Batch, realized_return: Array) -> Metrics:
        """SAC's instruments, and the ensemble's open-loop error."""
        errors = error_metrics(open_loop_error(state.world.ensemble, state.world.units, batch))
        return self._sac.diagnose(state.soft, batch, realized_return) | errors
