"""Stepping the environment: random steps, noise, seeds, faults, and playing the open episode again."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mbdpg.envs import episode_seed
from mbdpg.interfaces import EnvSpec, NonFiniteError, Step, UserError
from mbdpg.training.collector import FAULTS_IN_A_ROW, Collector
from mbdpg.training.replay import Replay

SPEC = EnvSpec("Walk-v0", observation_size=2, action_size=1, episode_limit=None, reference_return=10.0)
Fault = Callable[[int], None]


def no_fault(moment: int) -> None:
    pass


class Walk:
    """A point that its actions move; each episode's end follows from its seed, as do its observations.

    `fault` is called with the number of the step (-1 at a reset), counted over all environments of a `World`.
    """

    spec = SPEC

    def __init__(self, world: World) -> None:
        self._world = world
        self._world.made += 1
        self._place = self._origin = 0.0
        self._length, self._taken = 0, 0

    def reset(self, *, seed: int) -> np.ndarray:
        self._world.seeds.append(seed)
        self._world.fault(-1)
        chance = np.random.default_rng(seed)
        self._origin = self._place = float(chance.normal())
        self._length, self._taken = int(chance.integers(3, 9)), 0
        return self._seen()

    def step(self, action: np.ndarray) -> Step:
        number, self._world.steps = self._world.steps, self._world.steps + 1
        self._world.actions.append(action)
        self._world.fault(number)
        self._place += float(action[0])
        self._taken += 1
        over = self._taken == self._length
        ends = over and self._length % 2 == 0, over and self._length % 2 == 1
        return Step(self._seen(), self._place, *ends)

    def render(self) -> np.ndarray:
        raise NotImplementedError

    def close(self) -> None:
        self._world.closed += 1
        self._world.fault(-2)

    def _seen(self) -> np.ndarray:
        return np.array([self._place + self._world.drift, self._origin], np.float32)


class World:
    """Everything that a run's environments share, so that tests can look at it and break it."""

    def __init__(self, fault: Fault = no_fault) -> None:
        self.fault = fault
        self.made = self.closed = self.steps = 0
        self.drift = 0.0
        self.seeds: list[int] = []
        self.actions: list[np.ndarray] = []

    def make(self) -> Walk:
        return Walk(self)


def policy(observation: np.ndarray) -> np.ndarray:
    return np.tanh(observation[:1])


def collector(world: World, *, seed: int = 3, random_steps: int = 10) -> Collector:
    return Collector(world.make, seed, Replay(2, 1), random_steps=random_steps)


def bytes_of(replay: Replay) -> dict[str, bytes]:
    return {name: column.tobytes() for name, column in replay.columns().items()}


def failing_at(*moments: int, error: Exception | None = None) -> Fault:
    def fault(moment: int) -> None:
        if moment in moments:
            raise error or NonFiniteError("Walk-v0 returned the reward nan")

    return fault


def test_the_first_steps_are_uniform_and_know_no_policy() -> None:
    def refuse(observation: np.ndarray) -> np.ndarray:
        raise AssertionError("the policy was asked")

    world = World()
    made = collector(world, random_steps=2000)
    made.collect(refuse, 0.3, 2000)
    actions = np.concatenate(world.actions)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1
    assert abs(actions.mean()) < 0.04 and abs(actions.std() - np.sqrt(1 / 3)) < 0.03
    with pytest.raises(AssertionError, match="asked"):
        made.collect(lambda observation: (_ for _ in ()).throw(UserError("the policy was asked")), 0.3, 1)
    pytest.fail("unreachable") if made.env_steps != 2000 else None
