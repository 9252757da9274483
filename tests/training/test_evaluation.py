"""Episodes without exploration, what they returned, and what is made of them when the environment fails."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mbdpg.interfaces import EnvSpec, NonFiniteError, Sampling, Step, UserError
from mbdpg.training.evaluation import diagnosis_windows, evaluate, realized_returns
from mbdpg.training.replay import Replay

Ends = Callable[[int], tuple[bool, bool]]


class Count:
    """Observes the number of the step and the seed; pays the step's number plus the action."""

    spec = EnvSpec("Count-v0", observation_size=2, action_size=1, episode_limit=None, reference_return=None)
    frames_per_second = 50.0

    def __init__(self, ends: Ends, faults: dict[int, tuple[int, Exception]] | None = None) -> None:
        self._ends = ends
        self._faults = faults or {}
        self._seed = self._taken = 0

    def reset(self, *, seed: int) -> np.ndarray:
        self._seed, self._taken = seed, 0
        self._fail(0)
        return np.array([0, seed], np.float32)

    def step(self, action: np.ndarray) -> Step:
        self._taken += 1
        self._fail(self._taken)
        observation = np.array([self._taken, self._seed], np.float32)
        return Step(observation, self._taken + float(action[0]), *self._ends(self._taken))

    def render(self) -> np.ndarray:
        return np.full((2, 2, 3), self._taken, np.uint8)

    def close(self) -> None:
        pass

    def _fail(self, step: int) -> None:
        if self._seed in self._faults and self._faults[self._seed][0] == step:
            raise self._faults[self._seed][1]


def after(length: int, *, truncated: bool = False) -> Ends:
    return lambda taken: (taken == length and not truncated, taken == length and truncated)


def half(observation: np.ndarray) -> np.ndarray:
    return np.full(1, 0.5, np.float32)


def test_one_episode_per_seed_without_noise() -> None:
    found = evaluate(Count(after(3)), half, [7, 8])
    assert found.returns == [7.5, 7.5] and found.lengths == [3, 3] and found.faults == 0
    columns = found.steps.columns()
    np.testing.assert_array_equal(columns["observation"][:, 1], [7, 7, 7, 8, 8, 8])
    np.testing.assert_array_equal(columns["action"], np.full((6, 1), 0.5))
    np.testing.assert_array_equal(columns["terminated"], [0, 0, 1, 0, 0, 1])


def test_a_film_has_one_frame_per_step() -> None:
    frames: list[np.ndarray] = []
    evaluate(Count(after(3)), half, [0], on_frame=frames.append)
    assert [int(frame[0, 0, 0]) for frame in frames] == [0, 1, 2]


@pytest.mark.parametrize(("at", "kept"), [(0, 0), (1, 0), (3, 2)])
@pytest.mark.parametrize("error", [NonFiniteError("reward nan"), RuntimeError("sim\ncrashed")], ids=["nan", "raises"])
def test_an_episode_in_which_the_environment_fails_is_dropped_counted_and_said(
    at: int, kept: int, error: Exception, capsys: pytest.CaptureFixture[str]
) -> None:
    found = evaluate(Count(after(3), {8: (at, error)}), half, [7, 8, 9])
    assert found.returns == [7.5, 7.5] and found.lengths == [3, 3] and found.faults == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"evaluation episode dropped, Count-v0 failed ({type(error).__name__}: " in said
    columns = found.steps.columns()
    assert found.steps.size == 6 + kept  # the steps before the fault are real ones
    if kept:
        assert columns["truncated"][3 + kept - 1]
    np.testing.assert_array_equal(columns["start"][-3:], [3 + kept] * 3)


def test_when_every_episode_fails_nothing_is_left() -> None:
    found = evaluate(Count(after(3), {7: (0, NonFiniteError("nan"))}), half, [7])
    assert (found.returns, found.lengths, found.faults, found.steps.size) == ([], [], 1, 0)


def test_what_a_policy_raises_is_not_the_environment_s_fault() -> None:
    def broken(observation: np.ndarray) -> np.ndarray:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        evaluate(Count(after(3)), broken, [7])


def test_what_the_user_can_mend_is_not_dropped() -> None:
    with pytest.raises(UserError, match="of shape"):
        evaluate(Count(after(3), {7: (2, UserError("an observation of shape (3,)"))}), half, [7])


def steps_of(*episodes: tuple[int, str]) -> tuple[Replay, np.ndarray]:
    """A replay of episodes (length, end), and its rewards."""
    replay, chance = Replay(2, 1), np.random.default_rng(0)
    for length, end in episodes:
        for step in range(length):
            last = step == length - 1
            ends = last and end == "terminated", last and end == "truncated"
            replay.add(np.zeros(2, np.float32), np.zeros(1, np.float32), chance.normal(), np.ones(2, np.float32), *ends)
    return replay, replay.columns()["reward"].astype(np.float64)


def test_realized_returns_are_those_of_numpy() -> None:
    replay, reward = steps_of((5, "terminated"), (3, "terminated"))
    expected = [
        sum(0.9**k * reward[t + k] for k in range(end - t))
        for end, rows in ((5, range(5)), (8, range(5, 8)))
        for t in rows
    ]
    found = realized_returns(replay, 0.9)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(("discount", "tail"), [(0.9, 29), (0.99, 299)])
def test_realized_returns_near_a_time_limit_are_unknown(discount: float, tail: int) -> None:
    length = tail + 10
    replay, reward = steps_of((length, "truncated"), (4, "terminated"), (6, "truncated"))
    found = realized_returns(replay, discount)
    np.testing.assert_array_equal(np.isnan(found), [False] * 10 + [True] * tail + [False] * 4 + [True] * 6)
    np.testing.assert_allclose(found[:10], [np.polyval(reward[t:length][::-1], discount) for t in range(10)], rtol=1e-5)
    assert discount**tail < 0.05 < discount ** (tail - 1)


def test_without_a_discount_all_of_what_a_time_limit_cut_is_unknown() -> None:
    """It counted as known, though as much may have been to come as was there."""
    replay, _ = steps_of((400, "truncated"), (3, "terminated"))
    np.testing.assert_array_equal(np.isnan(realized_returns(replay, 1.0)), [True] * 400 + [False] * 3)


def test_realized_returns_of_an_open_episode_do_not_leak_into_the_one_before() -> None:
    replay, reward = steps_of((2, "terminated"), (3, "open"))
    found = realized_returns(replay, 0.9)
    np.testing.assert_allclose(found[:2], [reward[0] + 0.9 * reward[1], reward[1]], rtol=1e-6)


def test_diagnosis_windows_carry_the_return_of_their_own_first_step_after_the_burn_in() -> None:
    replay = evaluate(Count(after(6)), half, range(10)).steps
    sampling = Sampling(batch_size=40, burn_in=2, length=3)
    batch, realized = diagnosis_windows(replay, sampling, 0.9, np.random.default_rng(0))
    assert batch.observation.shape == (40, 5, 2) and realized.shape == (40,)
    first = batch.observation[:, 2]
    expected = realized_returns(replay, 0.9)[(first[:, 1] * 6 + first[:, 0]).astype(int)]
    np.testing.assert_array_equal(realized, expected)
    assert len(np.unique(first[:, 0])) == 6


def test_diagnosis_windows_never_cross_episodes() -> None:
    replay = evaluate(Count(after(4)), half, range(10)).steps
    batch, _ = diagnosis_windows(replay, Sampling(64, 3, 3), 0.9, np.random.default_rng(0))
    same = batch.observation[..., 1] == batch.observation[:, 3:4, 1]
    assert same.all()
    offset = batch.observation[..., 0] - batch.observation[:, 3:4, 0]
    np.testing.assert_array_equal(batch.valid == 1, (offset == np.arange(-3, 3)))
