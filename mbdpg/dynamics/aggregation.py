"""Several independent Gaussian networks as one model: the alternatives to one mixture that Fig. 6 compares."""

from __future__ import annotations

from typing import Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mbdpg.dynamics.mixture import Memory, MixtureDynamics, Outcome, Prediction

Aggregation = Literal["none", "bagging", "boosting"]
"""How several networks become one model; "none" where there is but one."""


@final
class Aggregate(eqx.Module):
    """Networks of one Gaussian each, with the methods of `MixtureDynamics` that open-loop prediction and its loss use.

    Bagging averages members that were trained apart, each on a resample of the episodes. Boosting adds them up: each
    was trained, and only the last still is, on what the sum of those before it leaves. Every member has its own memory;
    they are kept side by side along the last axis.
    """

    members: tuple[MixtureDynamics, ...]
    kind: Aggregation = eqx.field(static=True)

    def initial_memory(self, batch: tuple[int, ...]) -> Memory:
        """Zeros, the memory at an episode's start."""
        return _joined([member.initial_memory(batch) for member in self.members])

    def remember(
        self, memory: Memory, observation: Float[Array, "*batch observation"], action: Float[Array, "*batch action"]
    ) -> Memory:
        """Every member's memory of this step."""
        pairs = zip(self._learning(), self._parts(memory), strict=True)
        return _joined([member.remember(own, observation, action) for member, own in pairs])

    def predict(
        self, memory: Memory, observation: Float[Array, "*batch observation"], action: Float[Array, "*batch action"]
    ) -> Prediction:
        """One Gaussian: around the members' average, or the last member's, moved by the sum of the others."""
        pairs = zip(self._learning(), self._parts(memory), strict=True)
        *before, last = [member.predict(own, observation, action) for member, own in pairs]
        others = [prediction.mean()[..., None, :] for prediction in before]
        mean = sum(others, start=last.means)
        return last._replace(means=mean / len(self.members) if self.kind == "bagging" else mean)

    def outcome(
        self,
        memory: Memory,
        observation: Float[Array, "*batch observation"],
        action: Float[Array, "*batch action"],
        delta: Float[Array, "*batch observation"],
    ) -> Outcome:
        """The last member's."""
        return self.members[-1].outcome(self._parts(memory)[-1], observation, action, delta)

    def _learning(self) -> tuple[MixtureDynamics, ...]:
        """The members, of which only the last learns; gradients still pass through the others' predictions."""
        return (*map(jax.lax.stop_gradient, self.members[:-1]), self.members[-1])

    def _parts(self, memory: Memory) -> list[Memory]:
        parts = (jnp.split(x, len(self.members), axis=-1) for x in memory)
        return [Memory(*pair) for pair in zip(*parts, strict=True)]


def _joined(memories: list[Memory]) -> Memory:
    return Memory(*(jnp.concatenate(parts, axis=-1) for parts in zip(*memories, strict=True)))
