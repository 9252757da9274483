"""Acting by planning: the cross-entropy method on rollouts of an ensemble (Chua et al. 2018, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from mbdpg.dynamics.ensemble import Ensemble, Step, Units, predict
from mbdpg.dynamics.termination import RULES
from mbdpg.networks.leaves import leaf_name

MOST = 10**9
"""A stranger's planner may not take more numbers than this for its layers, nor more rows of them for a plan."""


def cross_entropy(
    score: Callable[[Float[Array, "plan time action"]], Float[Array, " plan"]],
    mean: Float[Array, "time action"],
    *,
    population: int,
    elites: int,
    iterations: int,
    smoothing: float,
    key: PRNGKeyArray,
) -> Float[Array, "time action"]:
    """The mean of a Gaussian over action sequences in [-1, 1] that is moved to its best draws again and again.

    As in the authors' code: draws within two standard deviations, and a variance that keeps those within the bounds.

    Args:
        score: what to maximize.
        mean: where to begin; the standard deviation begins at a quarter of the action range.
        population: sequences drawn per iteration.
        elites: of which so many decide the next Gaussian.
        iterations: how often.
        smoothing: share of the old mean and variance that is kept.
        key: decides the draws.
    """

    def iterate(carry: tuple[Array, Array], key: Array) -> tuple[tuple[Array, Array], None]:
        mean, variance = carry
        room = jnp.square(jnp.minimum(mean + 1.0, 1.0 - mean) / 2.0)
        std = jnp.sqrt(jnp.minimum(variance, room))
        plans = mean[None] + std[None] * jax.random.truncated_normal(key, -2.0, 2.0, (population, *mean.shape))
        best = plans[jax.lax.top_k(score(plans), elites)[1]]
        mean = smoothing * mean + (1.0 - smoothing) * jnp.mean(best, axis=0)
        return (mean, smoothing * variance + (1.0 - smoothing) * jnp.var(best, axis=0)), None

    begin = (mean, jnp.full_like(mean, 0.25))
    return jax.lax.scan(iterate, begin, jax.random.split(key, iterations))[0][0]


class Planner(eqx.Module):
    """What is needed to plan: a learned world, and how far and how hard to think."""

    ensemble: Ensemble
    units: Units
    horizon: int = eqx.field(static=True)
    """Steps of a plan."""
    particles: int = eqx.field(static=True)
    """Imagined rollouts of every plan and member; each stays with its member (TS-infinity)."""
    population: int = eqx.field(static=True)
    plan_elites: int = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    smoothing: float = eqx.field(static=True)
    discount: float = eqx.field(static=True)
    rule: str | None = eqx.field(static=True)
    """Name of the known rule by which episodes end; None if the ensemble knows."""

    @property
    def action_size(self) -> int:
        return int(self.ensemble.members.hidden[0].weight.shape[-2]) - self.units.delta.shape[-1]

    def imagined_return(
        self, observation: Float[Array, " observation"], plans: Float[Array, "plan time action"], *, key: PRNGKeyArray
    ) -> Float[Array, " plan"]:
        """Mean over members and particles of the discounted reward that each plan earns while it survives."""
        members, count = self.ensemble.members.output.bias.shape[0], plans.shape[0]
        lead = (members, count, self.particles)
        start = jnp.broadcast_to(observation, (*lead, observation.shape[0]))

        def step(carry: tuple[Array, Array], inputs: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
            (state, alive), (action, key) = carry, inputs
            action = jnp.broadcast_to(action[None, :, None], (*lead, action.shape[-1]))

            def go_on(state: Array, action: Array) -> Step:
                return predict(self.ensemble, self.units, state, action, key=key)

            # One key for all: the particles of every plan have the same luck, so that plans differ by what they do.
            imagined = jax.vmap(go_on, in_axes=1, out_axes=1)(state, action)
            goes_on = imagined.continues
            if self.rule is not None:
                goes_on = RULES[self.rule](imagined.next_observation).astype(jnp.float32)
            reward = alive * (goes_on * imagined.reward + (1.0 - goes_on) * imagined.terminal_reward)
            return (imagined.next_observation, self.discount * alive * goes_on), reward

        inputs = (jnp.swapaxes(plans, 0, 1), jax.random.split(key, self.horizon))
        _, rewards = jax.lax.scan(step, (start, jnp.ones(lead)), inputs)
        found = jnp.mean(jnp.sum(rewards, axis=0), axis=(0, 2))
        # An imagined state that ran away must not win; to take the largest of it and a NaN would be a NaN.
        return jnp.where(jnp.isfinite(found), found, -jnp.inf)

    def plan(
        self, observation: Float[Array, " observation"], before: Float[Array, "time action"], *, key: PRNGKeyArray
    ) -> Float[Array, "time action"]:
        """The best sequence found from a raw observation, beginning from another."""
        # The same imagined noise in every iteration, so that an elite is one by what it does and not by its luck.
        noise_key, search_key = jax.random.split(key)
        return cross_entropy(
            lambda plans: self.imagined_return(observation, plans, key=noise_key),
            before,
            population=self.population,
            elites=self.plan_elites,
            iterations=self.iterations,
            smoothing=self.smoothing,
            key=search_key,
        )


@eqx.filter_jit
def _plan(planner: Planner, observation: Array, before: Array, key: PRNGKeyArray, step: Array) -> Array:
    return planner.plan(observation, before, key=jax.random.fold_in(key, step))


class PlanningPolicy:
    """Plans anew at every step, beginning from what was planned one step before."""

    def __init__(self, planner: Planner, *, key: PRNGKeyArray | None = None):
        """Begin without a plan; the key decides what is drawn."""
        self.arrays = planner_arrays(planner)
        self.observation_size, self.action_size = planner.units.delta.shape[0], planner.action_size
        self._planner = jax.tree.map(jnp.asarray, planner)
        self._key = jax.random.key(0) if key is None else key
        self._step = 0
        self.reset()

    def reset(self) -> None:
        """Forget the plan: a new episode begins."""
        self._rest = np.zeros((self._planner.horizon, self.action_size), np.float32)

    @property
    def memory(self) -> list[float]:
        """The number of steps so far, and the rest of the plan."""
        return [float(self._step), *self._rest.ravel().tolist()]

    @memory.setter
    def memory(self, values: list[float]) -> None:
        self._step = int(values[0])
        self._rest = np.asarray(values[1:], np.float32).reshape(self._planner.horizon, self.action_size)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The action, float32 in [-1, 1] of shape (action,), for a raw observation of shape (observation,)."""
        seen = np.asarray(observation, np.float32)
        if seen.shape != (self.observation_size,):
            raise ValueError(f"the policy takes observations of shape ({self.observation_size},), not {seen.shape}")
        now, before = jnp.asarray(seen), jnp.asarray(self._rest)
        plan = np.asarray(_plan(self._planner, now, before, self._key, jnp.uint32(self._step)))
        self._step += 1
        self._rest = np.concatenate([plan[1:], np.zeros_like(plan[:1])])
        return plan[0]

    def explore(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """The action with noise added to it."""
        return np.clip(self(observation) + noise, -1.0, 1.0).astype(np.float32)


_COUNTS, _SHARES = ("horizon", "particles", "population", "plan_elites", "iterations"), ("smoothing", "discount")
_HIDDEN = "ensemble/members/hidden/"


def planner_arrays(planner: Planner) -> dict[str, np.ndarray]:
    """A planner as named arrays, for a policy file."""
    arrays = {f"planner/{name}": np.asarray(getattr(planner, name)) for name in _COUNTS}
    arrays |= {f"planner/{name}": np.asarray(getattr(planner, name), np.float64) for name in _SHARES}
    arrays["planner/rule"] = np.frombuffer((planner.rule or "").encode(), np.uint8)
    leaves = jax.tree_util.tree_leaves_with_path(planner)
    return arrays | {leaf_name(path): np.asarray(leaf) for path, leaf in leaves}


def is_planner(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether these are what `planner_arrays` gives, and not a policy network's."""
    return "planner/rule" in arrays


def planner_of(arrays: Mapping[str, np.ndarray]) -> Planner:
    """Build the planner that `planner_arrays` took apart, perhaps a stranger's.

    Raises:
        ValueError: an array is missing, misshapen or not finite, or a setting is impossible.
    """
    try:
        numbers = {name: arrays[f"planner/{name}"].item() for name in (*_COUNTS, *_SHARES)}
        rule = arrays["planner/rule"].tobytes().decode("ascii") or None
        layers = sum(name.startswith(_HIDDEN) and name.endswith("/weight") for name in arrays)
        count, inputs, _ = arrays[f"{_HIDDEN}0/weight"].shape
        widths = tuple(int(arrays[f"{_HIDDEN}{i}/weight"].shape[-1]) for i in range(layers))
        (size,) = arrays["units/delta"].shape
    except (KeyError, IndexError, ValueError) as error:
        raise ValueError(f"the planner is not whole ({error})") from error
    counts, shares = ([numbers[name] for name in names] for names in (_COUNTS, _SHARES))
    possible = all(type(x) is int and x > 0 for x in counts) and all(type(x) is float and 0 <= x <= 1 for x in shares)
    if not possible or numbers["plan_elites"] > numbers["population"] or inputs <= size or rule not in (None, *RULES):
        raise ValueError(f"the planner has the impossible settings {numbers}, rule {rule!r}")
    rows = count * numbers["particles"] * numbers["population"]
    if rows * max(inputs, *widths) * layers > MOST or rows * numbers["horizon"] * numbers["iterations"] > MOST:
        raise ValueError("the planner would think for too long")

    def fresh(key: PRNGKeyArray) -> Planner:
        ensemble = Ensemble(size, inputs - size, count=count, widths=widths, key=key)
        return Planner(ensemble=ensemble, units=Units.raw(size), rule=rule, **numbers)

    def take(path: Any, leaf: jax.ShapeDtypeStruct) -> Array:
        name = leaf_name(path)
        found = arrays.get(name)
        if found is None or (found.shape, found.dtype) != (leaf.shape, leaf.dtype) or not np.isfinite(found).all():
            raise ValueError(f"the planner's array {name} is not {leaf.dtype}{list(leaf.shape)} of finite numbers")
        if name.startswith("units/") and not name.endswith("mean") and not (found > 0).all():
            raise ValueError(f"the planner's array {name} is not positive")
        return jnp.asarray(found)

    return jax.tree_util.tree_map_with_path(take, jax.eval_shape(fresh, jax.random.key(0)))
