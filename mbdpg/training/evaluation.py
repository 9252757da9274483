"""Episodes of the deterministic policy that learning never sees, and what is measured on them."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from mbdpg.interfaces import Acting, Batch, Environment, Sampling
from mbdpg.training.faults import EnvironmentFailedError, guarded
from mbdpg.training.replay import Replay

UNSEEN = 0.05
"""A step's discounted return counts as known if at most this share of its weight lies beyond a time limit."""


class StoppedError(Exception):
    """Asked to stop in the middle of an evaluation; a resumed run begins it again."""


class Evaluation(NamedTuple):
    """Some episodes, but for those that the environment did not bring to an end."""

    returns: list[float]
    """Undiscounted, one per episode."""
    lengths: list[int]
    """Environment steps, one per episode."""
    steps: Replay
    """All their steps, and those before a fault."""
    faults: int = 0
    """Episodes dropped, because the environment raised or returned NaN."""


def evaluate(
    env: Environment,
    policy: Callable[[np.ndarray], np.ndarray],
    seeds: Sequence[int],
    on_frame: Callable[[np.ndarray], None] | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Evaluation:
    """Run one episode per environment seed, without noise.

    An episode in which the environment raises or returns NaN is dropped, counted, and said on stderr.

    Args:
        env: a fresh or used environment.
        policy: actions in [-1, 1] from raw observations.
        seeds: of the resets.
        on_frame: called with an RGB image before every step, if given.
        should_stop: asked before every step: an episode of somebody's environment may take minutes, or never end.

    Raises:
        StoppedError: `should_stop` said yes.
        UserError: the environment does not keep what its spaces promise.
    """
    steps = Replay(env.spec.observation_size, env.spec.action_size)
    returns, lengths, faults = [], [], 0
    for seed in seeds:
        try:
            total, length = _episode(env, policy, seed, steps, on_frame, should_stop)
        except EnvironmentFailedError as fault:
            faults += 1
            steps.close_episode()
            print(f"mbdpg: evaluation episode dropped, {env.spec.id} failed ({fault})", file=sys.stderr)
            continue
        returns.append(total)
        lengths.append(length)
    return Evaluation(returns, lengths, steps, faults)


def _episode(
    env: Environment,
    policy: Callable[[np.ndarray], np.ndarray],
    seed: int,
    steps: Replay,
    on_frame: Callable[[np.ndarray], None] | None,
    should_stop: Callable[[], bool],
) -> tuple[float, int]:
    """Append one episode to `steps`; return its return and length."""
    observation, total, length, over = guarded(partial(env.reset, seed=seed)), 0.0, 0, False
    if isinstance(policy, Acting):
        policy.reset()
    while not over:
        if should_stop():
            raise StoppedError
        if on_frame is not None:
            on_frame(env.render())
        action = np.asarray(policy(observation), np.float32)
        step = guarded(partial(env.step, action))
        steps.add(observation, action, step.reward, step.observation, step.terminated, step.truncated)
        observation, over = step.observation, step.terminated or step.truncated
        total, length = total + float(step.reward), length + 1
    return total, length


def realized_returns(steps: Replay, discount: float) -> np.ndarray:
    """Discounted return from every step of finished episodes to their end, float32.

    NaN shortly before a truncation (299 steps at discount 0.99, all with discount 1), where too much of what would
    follow was not seen.
    """
    columns = steps.columns()
    result = np.full(steps.size, np.nan, np.float32)
    tail = steps.size if discount == 1.0 else 0
    if 0.0 < discount < 1.0:
        tail = math.ceil(math.log(UNSEEN) / math.log(discount))
    value, known = 0.0, 0
    for row in range(steps.size - 1, -1, -1):
        if columns["terminated"][row]:
            value, known = 0.0, 0
        elif columns["truncated"][row]:
            value, known = 0.0, -tail
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
