"""Stepping one seed's environment with the behavior policy into its replay (Algorithm 1, line 5)."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from mbdpg.envs import episode_seed
from mbdpg.interfaces import Acting, Environment, UserError
from mbdpg.training.faults import EnvironmentFailedError, guarded
from mbdpg.training.randomness import NOISE_BLOCK, noise_block, random_stream
from mbdpg.training.replay import Replay

RECENT = 10
"""Training episodes whose mean return counts as the policy's."""

FAULTS_IN_A_ROW = 10
"""So many faults of the environment without one step between them end the run."""


class Collector:
    """One environment and everything that stepping it changes.

    An environment that raises or returns NaN loses its episode, never the run: the step is not recorded, what was
    recorded of the episode is closed as truncated, the environment is made anew and the fault is counted.
    """

    def __init__(
        self,
        make_env: Callable[[], Environment],
        seed: int,
        replay: Replay,
        *,
        random_steps: int,
        color: float,
        scatter: float,
    ):
        """Start the first episode; the replay may hold demonstrations already.

        Args:
            make_env: makes the environment, again after a fault.
            seed: decides episodes and noise.
            replay: gets every step.
            random_steps: environment steps with uniformly random actions, before the policy is asked.
            color: exponent of the noise's spectrum, 1 / f^color.
            scatter: each episode's noise is scaled by a uniform draw from [1 - scatter, 1 + scatter].
        """
        self.seed = seed
        self.replay = replay
        self.env_steps = 0
        self.faults = 0
        self.episode = 0
        self.returns: list[float] = []
        self.baseline: float | None = None
        self._random_steps = random_steps
        self._color = color
        self._scatter = scatter
        self._make_env = make_env
        self._env = make_env()
        self._broken = False
        self._faults_in_a_row = 0
        self._return = 0.0
        self._observation: np.ndarray | None = None
        self._memory: list[float] = []

    def collect(self, policy: Acting, std: float, steps: int) -> None:
        """Record `steps` environment steps, with uniformly random actions during the first `random_steps`.

        Args:
            policy: explores.
            std: standard deviation of the noise, its mean over episodes.
            steps: environment steps to take.
        """
        until = self.env_steps + steps
        if self._memory:
            policy.memory = self._memory
        while self.env_steps < until:
            try:
                if self._observation is None:
                    self._observation = self._reset()
                    policy.reset()
                self._step(self._action(policy, std))
            except EnvironmentFailedError as error:
                self._recover(error)
        self._memory = policy.memory
        if self.baseline is None and self.env_steps >= self._random_steps and self.returns:
            self.baseline = float(np.mean(self.returns))
        if self.baseline is not None:
            del self.returns[:-RECENT]

    @property
    def recent_return(self) -> float | None:
        """Mean return of the last training episodes; None before the first has ended."""
        return float(np.mean(self.returns[-RECENT:])) if self.returns else None

    def progress(self, reference_return: float | None) -> float:
        """How far the last training returns are on the way from a random policy's to the reference, in [0, 1]."""
        recent = self.recent_return
        if reference_return is None or self.baseline is None or recent is None:
            return 0.0
        span = max(reference_return - self.baseline, 1e-6)
        return float(np.clip((recent - self.baseline) / span, 0.0, 1.0))

    def facts(self) -> dict[str, Any]:
        """What a checkpoint must hold beside the replay."""
        return {
            "env_steps": self.env_steps,
            "faults": self.faults,
            "episode": self.episode,
            "returns": self.returns,
            "baseline": self.baseline,
            "faults_in_a_row": self._faults_in_a_row,
            "return": self._return,
            "memory": self._memory,
        }

    def restore(self, facts: Mapping[str, Any]) -> None:
        """Put back what `facts` gave, and play the open episode again up to where it was.

        An environment that does not repeat itself loses that episode, and the run says that it is no longer exact.
        """
        self.env_steps, self.faults, self.episode = facts["env_steps"], facts["faults"], facts["episode"]
        self.returns, self.baseline = list(facts["returns"]), facts["baseline"]
        self._faults_in_a_row, self._return = facts["faults_in_a_row"], facts["return"]
        self._memory = list(facts["memory"])
        observations, actions, after = self.replay.open_episode()
        if len(actions) == 0:
            return
        if self._repeat(observations[0], actions, after):
            return
        print(
            f"mbdpg: {self._env.spec.id} did not repeat its open episode, so this resume is not exact: "
            "that episode is closed and a new one begins",
            file=sys.stderr,
        )
        self._end_episode()
        self.replay.close_episode()

    def _repeat(self, first: np.ndarray, actions: np.ndarray, after: np.ndarray) -> bool:
        """Play an episode again from its seed; False, in no episode, if anything came out differently."""
        try:
            observation = self._reset()
            exact = np.array_equal(observation, first)
            for action, expected in zip(actions, after, strict=True):
                if not exact:
                    return False
                observation = guarded(partial(self._env.step, action)).observation
                exact = np.array_equal(observation, expected)
        except EnvironmentFailedError:  # it did not then
            self._broken, exact = True, False
        self._observation = observation if exact else None
        return exact

    def close(self) -> None:
        """Close the environment."""
        self._env.close()

    def _action(self, policy: Acting, std: float) -> np.ndarray:
        size = self._env.spec.action_size
        if self.env_steps < self._random_steps:
            return random_stream(self.seed, "uniform", self.env_steps).uniform(-1.0, 1.0, size).astype(np.float32)
        assert self._observation is not None
        block, row = divmod(self.env_steps, NOISE_BLOCK)
        std *= 1.0 + self._scatter * random_stream(self.seed, "scatter", self.episode).uniform(-1.0, 1.0)
        return policy.explore(self._observation, std * noise_block(self.seed, block, size, self._color)[row])

    def _step(self, action: np.ndarray) -> None:
        assert self._observation is not None
        step = guarded(partial(self._env.step, action))
        self.replay.add(self._observation, action, step.reward, step.observation, step.terminated, step.truncated)
        self.env_steps += 1
        self._faults_in_a_row = 0
        self._return += float(step.reward)
        self._observation = step.observation
        if step.terminated or step.truncated:
            self.returns.append(self._return)
            self._end_episode()

    def _reset(self) -> np.ndarray:
        if self._broken:
            with contextlib.suppress(Exception):  # it is broken
                self._env.close()
            self._env = guarded(self._make_env)
            self._broken = False
        return guarded(partial(self._env.reset, seed=episode_seed(self.seed, "train", self.episode)))

    def _end_episode(self) -> None:
        self.episode += 1
        self._return = 0.0
        self._observation = None

    def _recover(self, error: EnvironmentFailedError) -> None:
        self.faults += 1
        self._faults_in_a_row += 1
        if self._faults_in_a_row >= FAULTS_IN_A_ROW:
            raise UserError(
                f"{self._env.spec.id} failed {FAULTS_IN_A_ROW} times in a row ({error}); mend the environment, "
                "then continue with mbdpg resume"
            ) from error
        print(f"mbdpg: episode {self.episode} dropped, the environment failed ({error})", file=sys.stderr)
        self.replay.close_episode()
        self._end_episode()
        self._broken = True
