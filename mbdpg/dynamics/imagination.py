"""Trajectories imagined in the learned dynamics (Section 4.3, Algorithm 1 line 11)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mbdpg.dynamics.mixture import Memory, MixtureDynamics, Scales, next_observation

UNROLLED = 5
"""Steps per iteration of the compiled loop: XLA on CPU copies what a loop carries, and fuses nothing across it."""


class Trajectory(NamedTuple):
    """H imagined steps; the time axis is `time` = H for what happens in a step and `state` = H + 1 for states."""

    observations: Float[Array, "state *batch observation"]
    actions: Float[Array, "state *batch action"]
    """The last action is the policy's at the final state; no step is taken with it."""
    rewards: Float[Array, "time *batch"]
    """In units of the return scale; the terminal reward is mixed in by the probability of an end."""
    continues: Float[Array, "time *batch"]
    """Probability that the episode goes on after this step."""
    memory: Memory
    """After the last step."""

    def survival(self) -> Float[Array, "state *batch"]:
        """Probability of still being alive at each state: 1 at the first, then the product of `continues`."""
        alive = jnp.ones((1, *self.continues.shape[1:]))
        return jnp.concatenate([alive, jnp.cumprod(self.continues, axis=0)])


def imagine(
    dynamics: MixtureDynamics,
    scales: Scales,
    policy: Callable[[Array], Array],
    start: Float[Array, "*batch observation"],
    memory: Memory,
    *,
    horizon: int,
    detach_policy_input: bool = False,
    key: PRNGKeyArray | None = None,
) -> Trajectory:
    """Follow `policy` for `horizon` steps from normalized observations `start`.

    Args:
        dynamics: the Mixture Gaussian Network.
        scales: its units.
        policy: actions from normalized observations.
        start: first observations; gradient flows from each state to the next, and to every action.
        memory: the LSTM's state before the first step.
        horizon: H, the number of steps (the paper's 20).
        detach_policy_input: stop the gradient from actions to the states they were chosen in (the reading of Eq. 19).
        key: draw the next states from the mixture (Eq. 5, 12); without it they are deterministic (Eq. 13).
    """

    def act(observation: Array) -> Array:
        return policy(jax.lax.stop_gradient(observation) if detach_policy_input else observation)

    def step(carry: tuple[Array, Memory], t: Array) -> tuple[tuple[Array, Memory], tuple[Array, ...]]:
        observation, memory = carry
        action = act(observation)
        memory = dynamics.remember(memory, observation, action)
        prediction = dynamics.predict(memory, observation, action)
        delta = prediction.mean() if key is None else prediction.sample(key=jax.random.fold_in(key, t))
        after = next_observation(observation, delta, scales)
        outcome = dynamics.outcome(memory, observation, action, delta)
        alive = jax.nn.sigmoid(outcome.continue_logit)
        reward = alive * outcome.reward * scales.reward
        reward += (1.0 - alive) * outcome.terminal_reward * scales.terminal_reward
        return (after, memory), (observation, action, reward, alive)

    (last, memory), (observations, actions, rewards, continues) = jax.lax.scan(
        step, (start, memory), jnp.arange(horizon), unroll=max(min(horizon, UNROLLED), 1)
    )
    return Trajectory(
        observations=jnp.concatenate([observations, last[None]]),
        actions=jnp.concatenate([actions, act(last)[None]]),
        rewards=rewards,
        continues=continues,
        memory=memory,
    )


class Start(NamedTuple):
    """Where imagination begins."""

    observation: Float[Array, "batch observation"]
    memory: Memory
    weight: Float[Array, " batch"]
    """Probability that the episode goes on here; 0 where nothing may start."""
    depth: Float[Array, " batch"]
    """Imagined steps since a real state; 0 at a real one."""


class Ring(NamedTuple):
    """D_model of Algorithm 1: what was imagined last; new rows overwrite the oldest."""

    rows: Any
    """A pytree of arrays with a leading `slot` axis; zeros where nothing has been added yet."""
    added: Int[Array, ""]
    """Rows added; once the ring is full, less by whole rounds, so that no run is long enough to overflow it."""

    @classmethod
    def empty(cls, slots: int, row: Any) -> Ring:
        """Room for `slots` rows like the given one."""
        return cls(jax.tree.map(lambda x: jnp.zeros((slots, *x.shape), x.dtype), row), jnp.zeros((), jnp.int32))

    def add(self, rows: Any) -> Ring:
        """Overwrite the oldest rows with a batch of new ones, whose number divides that of the slots."""
        slots, batch = (jax.tree.leaves(x)[0].shape[0] for x in (self.rows, rows))
        at = jnp.mod(self.added, slots)

        def write(old: Array, new: Array) -> Array:
            return jax.lax.dynamic_update_slice_in_dim(old, new, at, axis=0)

        added = self.added + batch
        added = jnp.where(added >= 2 * slots, added - slots, added)
        return Ring(jax.tree.map(write, self.rows, rows), added)

    def sample(self, batch: int, *, key: PRNGKeyArray) -> Any:
        """Rows drawn uniformly from those added; zeros while there are none."""
        filled = jnp.minimum(self.added, jax.tree.leaves(self.rows)[0].shape[0])
        drawn = jax.random.randint(key, (batch,), 0, jnp.maximum(filled, 1))
        return jax.tree.map(lambda x: x[drawn], self.rows)
