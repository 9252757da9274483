"""An agent and an environment small enough to compile and run in a second, with everything that real ones have.

Tests get this module as the fixture `toy`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.experiments import run
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
    exploration_color: float = 0.0
    exploration_scatter: float = 0.0
    width: int = 3


class ToyState(NamedTuple):
    actor: Policy
    """What is learned; the behavior is its negative."""
    normalizer: Normalizer
    log: Any
    """A number that depends on every batch and key, and on their order."""
    updates: Any


class ToyAgent:
    """Two phases, and demonstrations if asked for; an update moves the policy by what the batch and the key say."""

    def __init__(self, env: EnvSpec, config: ToyConfig | None = None, phases: Sequence[Phase] = ()) -> None:
        self.config = config or ToyConfig()
        self.env = env
        self.phases = tuple(phases) or (
            Phase("fitting", 0.2, Sampling(3, 1, 2), 7, self.update),
            Phase("improving", 1.0, Sampling(4, 0, 1), 0, self.update),
        )

    def init(self, *, key: Any) -> ToyState:
        actor = Policy(self.env.observation_size, self.env.action_size, (self.config.width,), key=key)
        return ToyState(actor, identity(self.env.observation_size), jnp.zeros(()), jnp.zeros((), jnp.int32))

    def prepare(self, state: ToyState, statistics: Statistics) -> ToyState:
        return state._replace(normalizer=Normalizer(statistics.observation_mean, statistics.observation_std))

    def policy(self, state: ToyState) -> tuple[Policy, Normalizer]:
        return state.actor, state.normalizer

    def behavior(self, state: ToyState) -> tuple[Policy, Normalizer, Any]:
        return jax.tree.map(jnp.negative, state.actor), state.normalizer, jnp.full_like(state.log, 0.1)

    def update(self, state: ToyState, batch: Batch, *, key: Any) -> tuple[ToyState, Metrics]:
        seen = jnp.mean(batch.reward * batch.valid) + jax.random.normal(key, ())
        actor = jax.tree.map(lambda x: 0.9 * x + 0.01 * seen, state.actor)
        metrics = {"critic/loss": seen, "actor/objective": jnp.sum(actor.mlp.output.weight)}
        return ToyState(actor, state.normalizer, 0.99 * state.log + seen, state.updates + 1), metrics

    @property
    def diagnosis(self) -> Sampling:
        return Sampling(4, 1, 1)

    def diagnose(self, state: ToyState, batch: Batch, realized_return: Any) -> Metrics:
        return {"critic/q_bias": state.log + jnp.mean(batch.reward)}


class ToyEnv:
    """A point that actions move; episodes of 7 steps, every other terminated. `fault` sees (role, step of episode)."""

    spec = EnvSpec("Toy-v0", observation_size=2, action_size=1, episode_limit=7, reference_return=None)
    frames_per_second = 50.0

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
        self.saved: dict[str, np.ndarray] = {}
        self.checkpoints: list[tuple[int, dict[str, np.ndarray], dict[str, Any], dict[str, np.ndarray]]] = []

    def write(self, kind: str, env_steps: int, values: Metrics) -> None:
        untimed = {name: value for name, value in values.items() if not name.startswith("time/")}
        self.rows.append({"kind": kind, "env_steps": env_steps, **untimed})

    def save_policy(self, arrays: dict[str, np.ndarray], env_steps: int, return_mean: float) -> None:
        self.policies.append((env_steps, return_mean))
        self.saved = arrays

    def save_checkpoint(
        self, env_steps: int, arrays: dict[str, np.ndarray], facts: dict[str, Any], replay: dict[str, np.ndarray]
    ) -> None:
        self.checkpoints.append((env_steps, arrays, facts, {name: column.copy() for name, column in replay.items()}))


COMPILED: dict[Any, tuple[Learner, list[dict[str, np.ndarray]]]] = {}


def toy_learner(seeds: Sequence[int], env: EnvSpec = ToyEnv.spec, config: ToyConfig | None = None) -> Learner:
    """A fresh learner of the standard agent. Compiled once for each kind, so that there is one at a time of it."""
    config = config or ToyConfig()
    kind = tuple(seeds), env, config
    if kind not in COMPILED:
        learner = Learner(ToyAgent(env, config), seeds)
        COMPILED[kind] = learner, [learner.snapshot(index) for index in range(len(seeds))]
    learner, fresh = COMPILED[kind]
    learner.restore(fresh)
    return learner


@contextlib.contextmanager
def learned_by_toys() -> Iterator[None]:
    """Whatever agent a run asks for, it gets the toy agent of that width, compiled once."""

    def make_agent(config: Any, spec: EnvSpec) -> ToyAgent:
        return ToyAgent(spec, ToyConfig(random_steps=config.agent.random_steps, width=config.agent.width))

    def make_learner(agent: ToyAgent, seeds: Sequence[int]) -> Learner:
        return toy_learner(seeds, agent.env, agent.config)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "make_agent", make_agent)
        patch.setattr(run, "Learner", make_learner)
        yield


def toy_training(
    seeds: Sequence[int] = (0,),
    *,
    agent: ToyAgent | None = None,
    schedule: Schedule | None = None,
    make_env: Callable[[], ToyEnv] = ToyEnv,
    replay: Replay | None = None,
) -> tuple[Training, list[ToyRecorder]]:
    learner = toy_learner(seeds) if agent is None else Learner(agent, seeds)
    schedule = schedule or Schedule(
        steps=60, cycle=5, evaluate_every=20, evaluation_episodes=2, log_every=10, checkpoint_every=30
    )
    recorders = [ToyRecorder() for _ in seeds]
    collectors = [
        Collector(
            ToyEnv, seed, replay or Replay(2, 1), random_steps=learner.agent.config.random_steps, color=0.0, scatter=0.0
        )
        for seed in seeds
    ]
    return Training(learner, collectors, make_env, recorders, schedule), recorders
