"""Episodes of the deterministic policy that learning never sees, and what is measured on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mbdpg.interfaces import Batch, Environment, Sampling
from mbdpg.training.replay import Replay

TAIL = 300
"""Steps before a time limit whose discounted return is not counted as known: the rest of it was never seen."""


class Evaluation(NamedTuple):
    """Some episodes."""

    returns: list[float]
    """Undiscounted, one per episode."""
    lengths: list[int]
    """Environment steps, one per episode."""
    steps: Replay
    """All their steps."""


def evaluate(
    env: Environment,
    policy: Callable[[np.ndarray], np.ndarray],
    seeds: Sequence[int],
    on_frame: Callable[[np.ndarray], None] | None = None,
) -> Evaluation:
    """Run one episode per environment seed, without noise.

    Args:
        env: a fresh or used environment.
        policy: actions in [-1, 1] from raw observations.
        seeds: of the resets.
        on_frame: called with an RGB image before every step, if given.

    Raises:
        NonFiniteError: the environment returned NaN or an infinity.
    """
    steps = Replay(env.spec.observation_size, env.spec.action_size)
    returns, lengths = [], []
    for seed in seeds:
        observation, total, length, over = env.reset(seed=seed), 0.0, 0, False
        while not over:
            if on_frame is not None:
                on_frame(env.render())
            action = np.asarray(policy(observation), np.float32)
            step = env.step(action)
            steps.add(observation, action, step.reward, step.observation, step.terminated, step.truncated)
            observation, over = step.observation, step.terminated or step.truncated
            total, length = total + float(step.reward), length + 1
        returns.append(total)
        lengths.append(length)
    return Evaluation(returns, lengths, steps)


def realized_returns(steps: Replay, discount: float) -> np.ndarray:
    """Discounted return from every step of finished episodes to their end, float32.

    NaN within `TAIL` steps of a truncation, where what would have followed is unknown.
    """
    columns = steps.columns()
    result = np.full(steps.size, np.nan, np.float32)
    value, known = 0.0, 0
    for row in range(steps.size - 1, -1, -1):
        if columns["terminated"][row]:
            value, known = 0.0, 0
        elif columns["truncated"][row]:
            value, known = 0.0, -TAIL
        value = float(columns["reward"][row]) + discount * value
        known += 1
        if known > 0:
            result[row] = value
    return result


def diagnosis_windows(
    steps: Replay, sampling: Sampling, discount: float, rng: np.random.Generator
) -> tuple[Batch, np.ndarray]:
    """Windows for an agent's instruments and the return realized from each window's first step after the burn-in."""
    rows = rng.integers(0, steps.size, (1, sampling.batch_size))
    batch = steps.windows(rows, sampling)
    return Batch(*(array[0] for array in batch)), realized_returns(steps, discount)[rows[0]]
