"""Probabilistic ensembles with trajectory sampling (Chua et al. 2018): an ensemble is fitted, acting is planning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from mbdpg.dynamics.accuracy import DEPTHS, error_metrics
from mbdpg.dynamics.ensemble import Units, open_loop_error
from mbdpg.dynamics.planning import Planner
from mbdpg.dynamics.termination import known_rule
from mbdpg.dynamics.world import Fitting, World
from mbdpg.interfaces import Batch, EnvSpec, Metrics, Phase, Sampling, Statistics, require, require_settings
from mbdpg.networks.normalizer import Normalizer


@dataclass(frozen=True)
class Config:
    """Settings of PETS."""

    discount: float = 1.0
    """Discount factor gamma per step of a plan."""
    horizon: int = 20
    """Steps of a plan."""
    particles: int = 1
    """Imagined rollouts of each plan in each network; their product is the authors' number of particles."""
    population: int = 150
    """Plans drawn per iteration of the cross-entropy method."""
    plan_elites: int = 15
    """Best plans of an iteration, which decide the next one's distribution."""
    iterations: int = 3
    """Iterations of the cross-entropy method per environment step."""
    smoothing: float = 0.1
    """Share of the old distribution that an iteration keeps."""
    termination: Literal["learned", "known"] = "learned"
    """How imagined episodes end: as the ensemble has learned, or by the simulator's own rule, known for some tasks."""
    members: int = 5
    """Networks of the ensemble."""
    dynamics_width: int = 128
    """Width of each of their four hidden layers."""
    dynamics_learning_rate: float = 1e-3
    """Adam's step size for the ensemble."""
    weight_decay: float = 5e-5
    """Weight of half the ensemble's squared weights in its loss."""
    fits_per_step: float = 1.0
    """Updates of the ensemble per environment step."""
    pretraining_fits: int = 1000
    """Updates of the ensemble when the random steps are over."""
    fit_batch_size: int = 256
    """Transitions per update and member, drawn anew for each."""
    exploration_std: float = 0.0
    """Standard deviation of Gaussian noise on the planned action, its mean over episodes."""
    exploration_color: float = 0.0
    """That noise has power 1/f^color: 0 is white, 1 pink, correlated over many steps."""
    exploration_scatter: float = 0.0
    """Every episode's spread is drawn uniformly from within this share of its mean, from none to twice as much at 1."""
    random_steps: int = 1000
    """Environment steps with uniformly random actions before learning starts."""

    def __post_init__(self) -> None:
        planned = ("horizon", "particles", "population", "plan_elites", "iterations")
        fitted = ("members", "dynamics_width", "dynamics_learning_rate", "fit_batch_size")
        require_settings(
            self,
            positive=(*planned, *fitted),
            at_most={"discount": 1, "smoothing": 1, "exploration_scatter": 1, "exploration_color": 2},
        )
        few = f"--plan-elites is {self.plan_elites}, expected at most as many as --population, {self.population}"
        require(self.plan_elites <= self.population, few)


class PETS:
    """The agent; all that it learns is its world."""

    def __init__(self, config: Config, env: EnvSpec):
        """Build it.

        Raises:
            UserError: the rule by which episodes end is said to be known, and is not.
        """
        c = self.config = config
        self.env = env
        self._rule = known_rule(env) if c.termination == "known" else None
        # All members plan, so no step is held out to choose among them.
        rates = (c.dynamics_learning_rate, c.weight_decay)
        self._fitting = Fitting(c.members, c.dynamics_width, *rates, c.fit_batch_size, judged=False)
        sampling = self._fitting.sampling
        self.phases = (Phase("fitting", c.fits_per_step, sampling, c.pretraining_fits, self.fit),)

    def init(self, *, key: PRNGKeyArray) -> World:
        """Fresh networks."""
        return self._fitting.init(self.env, key=key)

    def prepare(self, state: World, statistics: Statistics) -> World:
        """Take over the replay's scales."""
        return eqx.tree_at(lambda x: x.units, state, Units.of(statistics))

    def policy(self, state: World) -> tuple[Planner, Normalizer]:
        """To plan."""
        c = self.config
        planner = Planner(
            ensemble=state.ensemble,
            units=state.units,
            horizon=c.horizon,
            particles=c.particles,
            population=c.population,
            plan_elites=c.plan_elites,
            iterations=c.iterations,
            smoothing=c.smoothing,
            discount=c.discount,
            rule=self._rule,
        )
        return planner, state.units.normalizer

    def behavior(self, state: World) -> tuple[Planner, Normalizer, Array]:
        """The same."""
        return *self.policy(state), jnp.asarray(self.config.exploration_std, jnp.float32)

    def fit(self, state: World, batch: Batch, *, key: PRNGKeyArray) -> tuple[World, Metrics]:
        """One update of the ensemble."""
        del key
        return self._fitting.fit(state, batch)

    @property
    def diagnosis(self) -> Sampling:
        """Windows long enough for the deepest open-loop error."""
        return Sampling(256, burn_in=0, length=max(DEPTHS))

    def diagnose(self, state: World, batch: Batch, realized_return: Array) -> Metrics:
        """The ensemble's open-loop error; there is no value to compare with returns."""
        del realized_return
        return error_metrics(open_loop_error(state.ensemble, state.units, batch))
