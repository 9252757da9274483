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
from mbdpg.training.randomness import NOISE_BLOCK, noise_block
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
    frames_per_second = 50.0

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


class Explorer:
    """A policy that explores, and counts what it was asked."""

    def __init__(self, of_observation: float = 1.0):
        self.arrays: dict[str, np.ndarray] = {}
        self.memory: list[float] = []
        self.asked, self.resets = 0, 0
        self._share = of_observation

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        return self._share * policy(observation)

    def explore(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        self.asked += 1
        return np.clip(self(observation) + noise, -1, 1).astype(np.float32)

    def reset(self) -> None:
        self.resets += 1


explore, noise_alone = Explorer(), Explorer(0.0)


def collector(world: World, *, seed: int = 3, random_steps: int = 10, scatter: float = 1.0) -> Collector:
    return Collector(world.make, seed, Replay(2, 1), random_steps=random_steps, color=1.0, scatter=scatter)


def bytes_of(replay: Replay) -> dict[str, bytes]:
    return {name: column.tobytes() for name, column in replay.columns().items()}


def failing_at(*moments: int, error: Exception | None = None) -> Fault:
    def fault(moment: int) -> None:
        if moment in moments:
            raise error or NonFiniteError("Walk-v0 returned the reward nan")

    return fault


def test_the_first_steps_are_uniform_and_know_no_policy() -> None:
    world, explorer = World(), Explorer()
    made = collector(world, random_steps=2000)
    made.collect(explorer, 0.3, 2000)
    actions = np.concatenate(world.actions)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1
    assert abs(actions.mean()) < 0.04 and abs(actions.std() - np.sqrt(1 / 3)) < 0.03
    assert not explorer.asked
    made.collect(explorer, 0.3, 1)
    assert explorer.asked == 1


def test_the_policy_hears_of_every_new_episode() -> None:
    explorer, made = Explorer(), collector(World())
    made.collect(explorer, 0.3, 500)
    assert explorer.resets == made.episode + made.replay.episode_open > 3


def test_after_them_the_policy_acts_with_noise_of_the_given_size_inside_the_bounds() -> None:
    world = World()
    made = collector(world, random_steps=0, scatter=0.0)
    made.collect(noise_alone, 0.3, 2000)
    actions = np.concatenate(world.actions)
    assert abs(actions.mean()) < 0.03 and abs(actions.std() - 0.3) < 0.03
    made.collect(explore, 5.0, 200)
    assert np.abs(np.concatenate(world.actions)).max() == 1


def test_where_noise_is_scattered_some_episodes_have_little_and_others_much() -> None:
    world = World()
    made = collector(world, random_steps=0)
    made.collect(noise_alone, 0.3, 4000)
    actions = np.concatenate(world.actions)
    columns = made.replay.columns()
    spreads = np.array([actions[columns["start"] == start].std() for start in np.unique(columns["start"])])
    assert spreads.min() < 0.05 and spreads.max() > 0.5
    assert np.sqrt(np.mean(actions**2)) == pytest.approx(0.3 * 2 / np.sqrt(3), rel=0.1)  # of a uniform spread


def test_without_noise_the_action_is_the_policy_s() -> None:
    world = World()
    made = collector(world, random_steps=0)
    made.collect(explore, 0.0, 20)
    columns = made.replay.columns()
    np.testing.assert_array_equal(columns["action"], [policy(observation) for observation in columns["observation"]])


def test_noise_is_a_function_of_seed_step_and_episode_alone() -> None:
    def noise(seed: int, pieces: list[int]) -> np.ndarray:
        world = World()
        made = collector(world, seed=seed, random_steps=4)
        for piece in pieces:
            made.collect(noise_alone, 0.1, piece)
        return np.concatenate(world.actions)

    np.testing.assert_array_equal(noise(3, [12]), noise(3, [1, 4, 7]))
    assert not np.isin(noise(3, [12]), noise(4, [12])).any()
    assert len(np.unique(noise(3, [12]))) == 12


def test_terminated_and_truncated_are_stored_apart_and_no_transition_crosses_a_reset() -> None:
    world = World()
    made = collector(world)
    made.collect(explore, 0.1, 200)
    columns = made.replay.columns()
    assert columns["terminated"].sum() > 5 and columns["truncated"].sum() > 5
    assert not (columns["terminated"] & columns["truncated"]).any()
    ended = columns["terminated"] | columns["truncated"]
    lengths = np.diff(np.flatnonzero(np.r_[True, ended]))
    kinds = columns["terminated"][ended]
    assert all((length % 2 == 0) == kind for length, kind in zip(lengths[1:], kinds[1:], strict=True))
    follows = columns["observation"][1:] == columns["next_observation"][:-1]
    assert follows[~ended[:-1]].all()
    assert not follows[ended[:-1]].all(axis=1).any()


def test_each_episode_has_its_own_seed_from_that_of_the_run() -> None:
    world = World()
    made = collector(world, seed=7)
    made.collect(explore, 0.1, 100)
    assert world.seeds == [episode_seed(7, "train", episode) for episode in range(len(world.seeds))]
    assert len(world.seeds) > 10
    assert made.episode in (len(world.seeds) - 1, len(world.seeds))


def test_returns_are_the_sums_of_the_recorded_rewards() -> None:
    made = collector(World())
    made.collect(explore, 0.1, 100)
    columns = made.replay.columns()
    ends = np.flatnonzero(columns["terminated"] | columns["truncated"]) + 1
    sums = [part.sum(dtype=np.float64) for part in np.split(columns["reward"], ends)[:-1]]
    assert len(sums) > 10
    np.testing.assert_allclose(made.returns, sums[-10:], rtol=1e-5)  # the last ten are all that is kept


def test_progress_goes_from_random_returns_to_the_reference() -> None:
    made = collector(World())
    assert made.progress(10.0) == 0
    made.collect(explore, 0.1, 10)
    assert made.baseline == np.mean(made.returns)
    made.returns = [made.baseline + (10.0 - made.baseline) / 4] * 10
    assert made.progress(10.0) == pytest.approx(0.25)
    made.returns = [99.0] * 10
    assert made.progress(10.0) == 1
    made.returns = [-99.0] * 10
    assert made.progress(10.0) == 0
    assert made.progress(None) == 0


@pytest.mark.parametrize(
    "error", [NonFiniteError("observation entry 0 = nan"), RuntimeError("sim\ncrashed")], ids=["nan", "raises"]
)
def test_a_fault_drops_its_step_closes_the_episode_is_counted_and_rebuilds(
    error: Exception, capsys: pytest.CaptureFixture[str]
) -> None:
    world, whole = World(failing_at(13, error=error)), World()
    made, healthy = collector(world), collector(whole)
    healthy.collect(explore, 0.1, 13)
    assert healthy.replay.episode_open
    made.collect(explore, 0.1, 40)
    assert (made.env_steps, made.replay.size, made.faults) == (40, 40, 1)
    assert (world.made, world.closed) == (2, 1)
    columns = made.replay.columns()
    for name, column in healthy.replay.columns().items():
        np.testing.assert_array_equal(columns[name][:12], column[:12])
    assert columns["truncated"][12] and not columns["terminated"][12]
    assert columns["start"][13] == 13
    assert world.seeds == [episode_seed(3, "train", episode) for episode in range(len(world.seeds))]
    assert len(made.returns) == made.episode - 1  # that of the dropped one is unknown
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"episode {len(healthy.returns)} dropped, the environment failed ({type(error).__name__}: " in said


def test_a_fault_of_a_reset_loses_that_episode_alone() -> None:
    resets = iter([False, True, False, False])
    world = World(lambda moment: failing_at(-1)(-1) if moment == -1 and next(resets, False) else None)
    made = collector(world)
    made.collect(explore, 0.1, 30)
    assert (made.env_steps, made.faults, world.made) == (30, 1, 2)
    assert made.replay.columns()["truncated"].sum() + made.replay.columns()["terminated"].sum() == len(made.returns)


def test_an_environment_that_always_fails_ends_the_run_with_advice() -> None:
    world = World(failing_at(*range(5, 1000)))
    made = collector(world)
    with pytest.raises(UserError, match="Walk-v0 failed 10 times in a row .*; mend the environment") as caught:
        made.collect(explore, 0.1, 40)
    assert "\n" not in str(caught.value)
    assert made.env_steps == 5 and made.faults == FAULTS_IN_A_ROW


def test_faults_with_steps_between_them_do_not_end_the_run() -> None:
    made = collector(World(failing_at(*range(5, 1000, 3))))
    made.collect(explore, 0.1, 100)
    assert made.env_steps == 100 and made.faults > 3 * FAULTS_IN_A_ROW


def test_an_environment_that_cannot_even_be_closed_is_replaced() -> None:
    made = collector(World(failing_at(13, -2, error=EOFError("worker died"))))
    made.collect(explore, 0.1, 40)
    assert (made.env_steps, made.faults) == (40, 1)


def test_an_environment_that_cannot_be_made_again_at_once_is_tried_again() -> None:
    world, failures = World(failing_at(13)), iter([ConnectionError("no simulator"), ConnectionError("no simulator")])

    def make() -> Walk:
        if world.made and (error := next(failures, None)):
            raise error
        return world.make()

    made = Collector(make, 3, Replay(2, 1), random_steps=10, color=1.0, scatter=1.0)
    made.collect(explore, 0.1, 40)
    assert (made.env_steps, made.faults) == (40, 3)


def test_a_mistake_that_the_user_can_mend_is_no_fault() -> None:
    made = collector(World(failing_at(4, error=UserError("returned an observation of shape (3,)"))))
    with pytest.raises(UserError, match="of shape"):
        made.collect(explore, 0.1, 40)
    assert made.faults == 0


def cycles(made: Collector, count: int) -> Collector:
    for _ in range(count):
        made.collect(explore, 0.1, 1)
    return made


def test_noise_is_correlated_over_its_whole_block_and_the_next_block_is_another() -> None:
    world = World()
    made = collector(world, random_steps=0, scatter=0.0)
    made.env_steps = NOISE_BLOCK - 6
    made.collect(noise_alone, 0.1, 12)
    expected = np.concatenate([noise_block(3, 0, 1, 1.0)[-6:], noise_block(3, 1, 1, 1.0)[:6]])
    np.testing.assert_allclose(np.concatenate(world.actions), 0.1 * expected[:, 0], rtol=1e-6)


@pytest.mark.parametrize("steps", [0, 1, 9, 10, 11, 15, 16, 23, 24, 25, 26, 27])
def test_a_restored_collector_goes_on_bitwise(steps: int) -> None:
    whole = cycles(collector(World(failing_at(15))), 60)
    first = cycles(collector(World(failing_at(15))), steps)
    facts: dict[str, Any] = json.loads(json.dumps(first.facts()))
    world = World(failing_at(15 - steps) if steps <= 15 else no_fault)
    world.steps = -len(first.replay.open_episode()[1])  # those are played again, and not counted
    second = Collector(
        world.make, 3, Replay.from_columns(first.replay.columns()), random_steps=10, color=1.0, scatter=1.0
    )
    second.restore(facts)
    assert world.steps == 0
    cycles(second, 60 - steps)
    assert bytes_of(second.replay) == bytes_of(whole.replay)
    assert second.facts() == whole.facts()


def test_an_environment_that_does_not_repeat_itself_is_said_loudly_and_loses_that_episode(
    capsys: pytest.CaptureFixture[str],
) -> None:
    first, steps = collector(World()), 12
    first.collect(explore, 0.1, steps)
    while not first.replay.episode_open:
        steps += 1
        first.collect(explore, 0.1, 1)
    world = World()
    world.drift = 1e-6
    second = Collector(
        world.make, 3, Replay.from_columns(first.replay.columns()), random_steps=10, color=1.0, scatter=1.0
    )
    second.restore(first.facts())
    said = capsys.readouterr().err
    assert "Walk-v0 did not repeat its open episode, so this resume is not exact" in said
    assert said.count("\n") == 1
    assert second.replay.columns()["truncated"][-1] and not second.replay.episode_open
    assert second.episode == first.episode + 1
    second.collect(explore, 0.1, 30)
    assert second.replay.columns()["start"][steps] == steps
    assert world.seeds[1] == episode_seed(3, "train", first.episode + 1)


@pytest.mark.parametrize("moment", [-1, 0])
def test_an_environment_that_fails_while_its_episode_is_played_again_does_not_end_the_run(
    moment: int, capsys: pytest.CaptureFixture[str]
) -> None:
    first = collector(World())
    first.collect(explore, 0.1, 12)
    while not first.replay.episode_open:
        first.collect(explore, 0.1, 1)
    world = World(failing_at(moment))
    second = Collector(
        world.make, 3, Replay.from_columns(first.replay.columns()), random_steps=10, color=1.0, scatter=1.0
    )
    second.restore(first.facts())
    assert "this resume is not exact" in capsys.readouterr().err
    world.fault = no_fault
    second.collect(explore, 0.1, 30)
    assert second.env_steps == first.env_steps + 30
    assert world.made == 2
