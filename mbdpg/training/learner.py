"""An agent's state for several seeds at once: compiled updates, host copies of the policies, and exact snapshots."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mbdpg.dynamics.planning import Planner, PlanningPolicy
from mbdpg.interfaces import Acting, Agent, Batch, Metrics, Phase, Statistics, UserError
from mbdpg.networks.leaves import leaf_name
from mbdpg.networks.normalizer import Normalizer
from mbdpg.networks.policy import GaussianPolicy, NumpyPolicy, Policy, policy_arrays

EVALUATING, COLLECTING = 2**31, 2**31 + 1
"""What keys are folded with for planning, far from the numbers of phases."""


class Learner:
    """Holds the states of all seeds along a leading `seed` axis and runs k gradient steps per call."""

    def __init__(self, agent: Agent, seeds: Sequence[int], devices: Sequence[jax.Device] | None = None):
        """Initialize every seed's state from its own key.

        Args:
            agent: whose updates are taken.
            seeds: one state each.
            devices: share the seeds evenly, as many of them as can; by default all that this process has.

        Raises:
            MemoryError: the states alone are larger than this machine's memory, at which XLA would abort the process.
        """
        self.agent = agent
        mesh = seed_mesh(len(seeds), jax.local_devices() if devices is None else devices)
        numbers: Any = np.asarray(seeds, np.uint32)
        if devices is not None:
            numbers = jax.device_put(numbers, NamedSharding(mesh, _seed_axis()))

        def begin(seed: jax.Array) -> tuple[jax.Array, Any]:
            key = jax.random.key(seed)
            return key, agent.init(key=jax.random.fold_in(key, 0))

        begun = jax.jit(over_seeds(begin, mesh)).trace(numbers)
        size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(begun.out_info[1]))
        if size > os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"):
            raise MemoryError(f"the networks and their optimizers take {size / 2**30:.0f} GiB")
        self._keys, self.state = begun.lower().compile()(numbers)
        self._prepare = jax.jit(over_seeds(agent.prepare, mesh), donate_argnums=0)
        self._diagnose = jax.jit(over_seeds(agent.diagnose, mesh))
        self._updates = {phase.name: _compile(phase, 1 + i, mesh) for i, phase in enumerate(agent.phases)}

    def prepare(self, statistics: Sequence[Statistics]) -> None:
        """Set each seed's scaling."""
        self.state = self._prepare(self.state, _stack(statistics))

    def update(self, phase: Phase, batches: Sequence[Batch], done: int) -> Metrics:
        """Take the gradient steps that `batches` hold, (updates, batch, ...) for each seed.

        Returns:
            Means over the steps, one array of shape (seed,) per metric.
        """
        self.state, metrics = self._updates[phase.name](
            self.state, _stack(batches), self._keys, np.full(len(self._keys), done, np.uint32)
        )
        return {name: np.asarray(value) for name, value in metrics.items()}

    def diagnose(self, batches: Sequence[Batch], realized: Sequence[np.ndarray]) -> Metrics:
        """The agent's instruments, one array of shape (seed,) per metric."""
        metrics = self._diagnose(self.state, _stack(batches), np.stack(realized))
        return {name: np.asarray(value) for name, value in metrics.items()}

    def policies(self) -> list[Acting]:
        """Each seed's policy as learned."""
        return self._on_host(*jax.vmap(self.agent.policy)(self.state), role=EVALUATING)

    def behaviors(self) -> tuple[list[Acting], np.ndarray]:
        """Each seed's policy for collecting, and the standard deviations of the noise."""
        policy, normalizer, std = jax.vmap(self.agent.behavior)(self.state)
        return self._on_host(policy, normalizer, role=COLLECTING), np.asarray(std)

    def _on_host(self, policy: Policy | GaussianPolicy | Planner, normalizer: Normalizer, *, role: int) -> list[Acting]:
        pairs = jax.device_get((policy, normalizer))
        each = [jax.tree.map(lambda x, i=i: x[i], pairs) for i in range(len(self._keys))]
        if isinstance(policy, Planner):
            keys = jax.vmap(jax.random.fold_in, (0, None))(self._keys, role)
            return [PlanningPolicy(planner, key=key) for (planner, _), key in zip(each, keys, strict=True)]
        return [NumpyPolicy(policy_arrays(*pair)) for pair in each]

    def snapshot(self, index: int) -> dict[str, np.ndarray]:
        """One seed's whole state as named arrays."""
        leaves = jax.tree_util.tree_leaves_with_path(self.state)
        return {leaf_name(path): np.asarray(leaf[index]) for path, leaf in leaves}

    def restore(self, snapshots: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Put back what `snapshot` gave, for every seed.

        Raises:
            UserError: an array is missing, or has another shape or type than this configuration's.
        """

        def put(path: Any, leaf: jax.Array) -> jax.Array:
            name, arrays = leaf_name(path), []
            for snapshot in snapshots:
                found = snapshot.get(name)
                if found is None or found.shape != leaf.shape[1:] or found.dtype != leaf.dtype:
                    have = "nothing" if found is None else f"{found.dtype}{list(found.shape)}"
                    raise UserError(
                        f"the checkpoint does not fit this configuration: {name} is {have}, "
                        f"expected {leaf.dtype}{list(leaf.shape[1:])}"
                    )
                arrays.append(found)
            # Bound to a device only if it was: else the updates would be compiled anew, for another kind of argument.
            return jax.device_put(np.stack(arrays), leaf.sharding if leaf.committed else None)

        self.state = jax.tree_util.tree_map_with_path(put, self.state)


def seed_mesh(seeds: int, devices: Sequence[jax.Device]) -> Mesh:
    """The seed axis over devices: over as many of them as get equally many seeds each."""
    count = max(n for n in range(1, len(devices) + 1) if seeds % n == 0)
    return Mesh(np.asarray(devices[:count]), ("seed",))


def over_seeds(function: Any, mesh: Mesh) -> Any:
    """Map a one-seed function over leading seed axes, each device its own seeds.

    On CPU one seed after the other, which computes for each exactly what it would alone; elsewhere all at once.
    """
    each = _one_by_one(function) if mesh.devices.flat[0].platform == "cpu" else jax.vmap(function)
    if mesh.size == 1:
        return each
    # Seeds tell each other nothing, so that there is nothing to check of what varies over devices.
    return jax.shard_map(each, mesh=mesh, in_specs=_seed_axis(), out_specs=_seed_axis(), check_vma=False)


def _seed_axis() -> PartitionSpec:
    return PartitionSpec("seed")  # type: ignore[no-untyped-call]


def _one_by_one(function: Any) -> Any:
    return lambda *args: jax.lax.map(lambda packed: function(*packed), args)


def _compile(phase: Phase, stream: int, mesh: Mesh) -> Any:
    """Gradient steps of a phase, each with the random numbers of its own stream and count."""

    def many(state: Any, batches: Batch, key: Any, done: Any) -> tuple[Any, Metrics]:
        def one(carry: Any, inputs: tuple[Any, Batch]) -> tuple[Any, Metrics]:
            step, batch = inputs
            return phase.update(carry, batch, key=jax.random.fold_in(own, step))

        own = jax.random.fold_in(key, stream)
        steps = done + jnp.arange(batches.reward.shape[0], dtype=jnp.uint32)
        state, metrics = jax.lax.scan(one, state, (steps, batches))
        return state, jax.tree.map(lambda x: jnp.mean(x.astype(jnp.float32)), metrics)

    return jax.jit(over_seeds(many, mesh), donate_argnums=0)


def _stack(items: Sequence[Any]) -> Any:
    """Join one pytree per seed along a new leading axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *items)
