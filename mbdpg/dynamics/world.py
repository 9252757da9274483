"""An ensemble while it is being fitted: what PETS and MBPO learn of their environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from mbdpg.dynamics.ensemble import Ensemble, Units, ensemble_loss, held_out_error
from mbdpg.interfaces import Batch, EnvSpec, Metrics, Part, Sampling
from mbdpg.networks.optimizer import adam


class World(eqx.Module):
    """Everything that fitting changes."""

    ensemble: Ensemble
    optimizer: Any
    units: Units
    errors: Float[Array, " member"]
    """Each member's held-out error, a running average; NaN before the first."""

    def elites(self, count: int) -> Array:
        """The members with the least held-out error, the best first."""
        return jnp.argsort(self.errors)[:count]


@dataclass(frozen=True)
class Fitting:
    """How an ensemble is fitted and judged."""

    members: int
    width: int
    """Of each of the four hidden layers."""
    learning_rate: float
    weight_decay: float
    batch_size: int
    """Transitions per update and member."""
    judged: bool
    """Some steps are held out from learning, to judge the members by."""

    @property
    def sampling(self) -> Sampling:
        """Steps to learn from: a batch for every member, drawn apart."""
        part: Part = "kept" if self.judged else "all"
        return Sampling(self.members * self.batch_size, burn_in=0, length=1, part=part)

    @property
    def judging(self) -> Sampling:
        """Steps to judge by."""
        return Sampling(1024, burn_in=0, length=1, part="held-out")

    @property
    def _optimizer(self) -> optax.GradientTransformation:
        return adam(self.learning_rate)

    def init(self, env: EnvSpec, *, key: PRNGKeyArray) -> World:
        """Fresh networks."""
        size, widths = env.observation_size, (self.width,) * 4
        ensemble = Ensemble(size, env.action_size, count=self.members, widths=widths, key=key)
        return World(ensemble, self._optimizer.init(ensemble), Units.raw(size), jnp.full(self.members, jnp.nan))

    def fit(self, world: World, batch: Batch) -> tuple[World, Metrics]:
        """One update of all members, each from steps of its own; `batch` is as `sampling` says."""
        batch = jax.tree.map(lambda x: x.reshape(self.members, self.batch_size, *x.shape[2:]), batch)
        (_, metrics), gradient = jax.value_and_grad(ensemble_loss, has_aux=True)(
            world.ensemble, world.units, batch, weight_decay=self.weight_decay
        )
        updates, optimizer = self._optimizer.update(gradient, world.optimizer)
        world = World(optax.apply_updates(world.ensemble, updates), optimizer, world.units, world.errors)
        return world, metrics | {"dynamics/skipped": optimizer.total_notfinite}

    def judge(self, world: World, batch: Batch) -> tuple[World, Metrics]:
        """Measure every member; `batch` is as `judging` says."""
        now = held_out_error(world.ensemble, world.units, jax.tree.map(lambda x: x[:, 0], batch))
        errors = jnp.where(jnp.isfinite(world.errors), 0.5 * (world.errors + now), now)
        return eqx.tree_at(lambda x: x.errors, world, errors), {"dynamics/held_out_mse": jnp.mean(now)}
