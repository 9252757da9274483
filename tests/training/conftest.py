"""An agent and an environment small enough to compile and run in a second, with everything that real ones have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.interfaces import Batch, EnvSpec, Metrics, Phase, Sampling, Statistics, Step
from mbdpg.networks.normalizer import Normalizer, identity
from mbdpg.networks.policy import Policy
from mbdpg.training.collector import Collector
from mbdpg.training.learner import Learner
from mbdpg.training.loop import Schedule, Training
from mbdpg.training.replay import Replay


@dataclass(frozen=True)
class ToyConfig:
    discount: float = 0.9
    random_steps: int = 20


class ToyState(NamedTuple):
    actor: Policy
    normalizer: Normalizer
    log: Any
    """A number that depends on every batch and key, and on their order."""
    updates: Any


class ToyAgent:
    """Two phases, and demonstrations if asked for; an update moves the policy by what the batch and the key say."""

    def __init__(self, env: EnvSpec, config: ToyConfig | None = None, phases: Sequence[Phase] = ()) -> None:
        self.config = config or ToyConfig()
        self.env = env
        start = self.config.random_steps
        self.phases = tuple(phases) or (
            Phase("fitting", 0.2, start, Sampling(3, 1, 2), 7, self.update),
            Phase("improving", 1.0, start, Sampling(4, 0, 1), 0, self.update),
        )

    def init(self, *, key: Any) -> ToyState:
        actor = Policy(self.env.observation_size, self.env.action_size, (3,), key=key)
        return ToyState(actor, identity(self.env.observation_size), jnp.zeros(()), jnp.zeros((), jnp.int32))

    def prepare(self, state: ToyState, statistics: Statistics) -> ToyState:
        return state._replace(normalizer=Normalizer(statistics.observation_mean, statistics.observation_std))

    def policy(self, state: ToyState) -> tuple[Policy, Normalizer]:
        return state.actor, state.normalizer

    def exploration_std(self, state: ToyState) -> Any:
        return jnp.full_like(state.log, 0.1)

    def update(self, state: ToyState, batch: Batch, *, key: Any) -> tuple[ToyState, Metrics]:
        seen = jnp.mean(batch.reward * batch.valid) + jax.random.normal(key, ())
        actor = jax.tree.map(lambda x: 0.9 * x + 0.01 * seen, state.actor)
        metrics = {"critic/loss": seen, "actor/objective": jnp.sum(actor.mlp.output.weight)}
        return ToyState(actor, state.normalizer, 0.99 * state.log + seen, state.updates + 1), metrics

    @property
    def diagnosis(self) -> Sampling:
        return Sampling(4, 1, 1)

    def diagnose(self, state: ToyState, batch: Batch, realized_return: Any, *, key: Any) -> Metrics:
        return {"critic/q_bias": state.log + jnp.mean(batch.reward) + 0.0 * jax.random.normal(key, ())}


class ToyEnv:
    """A point that actions move; episodes of 7 steps, every other terminated. `fault` sees (role, step of episode)."""

    spec = EnvSpec("Toy-v0", observation_size=2, action_size=1, episode_limit=7, reference_return=None)

    def __init__(self, fault: Callable[[int], None] = lambda step: None) -> None:
        self._fault = fault
        self._place, self._seed, self._taken = 0.0, 0, 0

    def reset(self, *, seed: int) -> np.ndarray:
        self._place, self._seed, self._taken = float(np.random.default_rng(seed).normal()), seed, 0
        self._fault(0)
        return np.array([self._place, 0.0], np.float32)

    def step(self, action: np.ndarray) -> Step:
        self._taken += 1
        self._fault(self._taken)
        self._place += float(action[0])
        over = self._taken == 7
        ends = over and self._seed % 2 == 0, over and self._seed % 2 == 1
        return Step(np.array([self._place, self._taken], np.float32), -abs(self._place), *ends)

    def render(self) -> np.ndarray:
        return np.zeros((4, 4, 3), np.uint8)

    def close(self) -> None:
        pass


class ToyRecorder:
    """Keeps what a run records."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self.policies: list[tuple[int, float]] = []
        self.checkpoints: list[tuple[int, dict[str, np.ndarray], dict[str, Any], dict[str, np.ndarray]]] = []

    def write(self, kind: str, env_steps: int, values: Metrics) -> None:
        untimed = {name: value for name, value in values.items() if not name.startswith("time/")}
        self.rows.append({"kind": kind, "env_steps": env_steps, **untimed})

    def save_policy(self, arrays: dict[str, np.ndarray], env_steps: int, return_mean: float) -> None:
        self.policies.append((env_steps, return_mean))

    def save_checkpoint(
        self, env_steps: int, arrays: dict[str, np.ndarray], facts: dict[str, Any], replay: dict[str, np.ndarray]
    ) -> None:
        self.checkpoints.append((env_steps, arrays, facts, {name: column.copy() for name, column in replay.items()}))


class Toy(NamedTuple):
    """The classes above, and a function that puts a run of them together."""

    agent: type[ToyAgent]
    config: type[ToyConfig]
    env: type[ToyEnv]
    recorder: type[ToyRecorder]
    training: Callable[..., tuple[Training, list[ToyRecorder]]]


COMPILED: dict[tuple[int, ...], tuple[Learner, list[dict[str, np.ndarray]]]] = {}


def toy_learner(seeds: Sequence[int]) -> Learner:
    """A fresh learner of the standard agent; compiled once, so that there is one at a time."""
    if tuple(seeds) not in COMPILED:
        learner = Learner(ToyAgent(ToyEnv.spec), seeds)
        COMPILED[tuple(seeds)] = learner, [learner.snapshot(index) for index in range(len(seeds))]
    learner, fresh = COMPILED[tuple(seeds)]
    learner.restore(fresh)
    return learner


def toy_training(
    seeds: Sequence[int] = (0,),
    *,
    agent: ToyAgent | None = None,
    schedule: Schedule | None = None,
    evaluation_env: ToyEnv | None = None,
    replay: Replay | None = None,
) -> tuple[Training, list[ToyRecorder]]:
    learner = toy_learner(seeds) if agent is None else Learner(agent, seeds)
    schedule = schedule or Schedule(
        steps=60, cycle=5, evaluate_every=20, evaluation_episodes=2, log_every=10, checkpoint_every=30
    )
    recorders = [ToyRecorder() for _ in seeds]
    collectors = [
        Collector(ToyEnv, seed, replay or Replay(2, 1), random_steps=learner.agent.config.random_steps)
        for seed in seeds
    ]
    return Training(learner, collectors, evaluation_env or ToyEnv(), recorders, schedule), recorders


@pytest.fixture(scope="session")
def toy() -> Toy:
    return Toy(ToyAgent, ToyConfig, ToyEnv, ToyRecorder, toy_training)
