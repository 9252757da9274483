"""The replay against a plain list of steps: windows, sampling, statistics, and rebuilding it to the last bit."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from mbdpg.interfaces import Batch, Sampling, Statistics, UserError
from mbdpg.training.replay import Replay

LENGTHS = (4, 1, 7, 2, 5)  # the last episode stays open
ENDS = ("terminated", "truncated", "terminated", "truncated", "open")


class Row(NamedTuple):
    """One step; `observation[0]` is the number of the row, `action[0]` that of its episode."""

    observation: np.ndarray
    action: np.ndarray
    reward: float
    next_observation: np.ndarray
    terminated: bool
    truncated: bool


def rows_of(lengths: tuple[int, ...] = LENGTHS, ends: tuple[str, ...] = ENDS) -> list[Row]:
    chance, rows = np.random.default_rng(5), []
    for episode, (length, end) in enumerate(zip(lengths, ends, strict=True)):
        for step in range(length):
            last = step == length - 1
            observation = np.array([len(rows), chance.normal(), 3.0], np.float32)
            after = np.array([len(rows) + 1, chance.normal(), 3.0], np.float32)
            action = np.array([episode / 10, chance.uniform(-1, 1)], np.float32)
            ended = last and end == "terminated", last and end == "truncated"
            rows.append(Row(observation, action, float(chance.normal()), after, *ended))
    return rows


def filled(rows: list[Row] | None = None, **settings: Any) -> Replay:
    replay = Replay(3, 2, **settings)
    for row in rows_of() if rows is None else rows:
        replay.add(*row)
    return replay


def same(left: dict[str, np.ndarray], right: dict[str, np.ndarray]) -> bool:
    return left.keys() == right.keys() and all(
        left[name].dtype == right[name].dtype and left[name].tobytes() == right[name].tobytes() for name in left
    )


def equal_statistics(left: Statistics, right: Statistics) -> bool:
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in zip(left, right, strict=True))


EPISODE_OF = [episode for episode, length in enumerate(LENGTHS) for _ in range(length)]


@pytest.mark.parametrize("sampling", [Sampling(1, 0, 1), Sampling(1, 3, 1), Sampling(1, 2, 4), Sampling(1, 9, 9)])
def test_a_window_holds_the_steps_around_its_row_and_never_those_of_another_episode(sampling: Sampling) -> None:
    rows, replay = rows_of(), filled()
    batch = replay.windows(np.arange(replay.size), sampling)
    assert batch.reward.shape == (19, sampling.burn_in + sampling.length)
    for row in range(19):
        for column, wanted in enumerate(range(row - sampling.burn_in, row + sampling.length)):
            inside = 0 <= wanted < 19 and EPISODE_OF[wanted] == EPISODE_OF[row]
            expected = rows[wanted if inside else row]
            assert batch.valid[row, column] == inside
            np.testing.assert_array_equal(batch.observation[row, column], expected.observation)
            np.testing.assert_array_equal(batch.action[row, column], expected.action)
            np.testing.assert_array_equal(batch.next_observation[row, column], expected.next_observation)
            assert batch.reward[row, column] == np.float32(expected.reward)
            assert batch.terminated[row, column] == expected.terminated  # of a truncated step: 0


def test_the_drawn_step_itself_is_always_valid() -> None:
    batch = filled().sample(50, Sampling(8, 4, 3), np.random.default_rng(0))
    assert batch.valid.shape == (50, 8, 7)
    assert (batch.valid[..., 4] == 1).all()
    assert 0 < batch.valid.mean() < 1
    assert {array.dtype for array in batch} == {np.dtype(np.float32)}


def test_an_episode_of_one_step_is_alone_in_its_window() -> None:
    np.testing.assert_array_equal(filled().windows(np.array([4]), Sampling(1, 2, 3)).valid, [[0, 0, 1, 0, 0]])


def test_the_oldest_and_the_newest_step_are_drawn_as_often_as_any_other() -> None:
    batch = filled().sample(19, Sampling(1000, 0, 1), np.random.default_rng(1))
    counts = np.bincount(batch.observation[..., 0, 0].astype(int).ravel(), minlength=19)
    assert len(counts) == 19
    # 1000 each, standard deviation 31.
    assert counts.min() > 860 and counts.max() < 1140


def test_sampling_is_a_function_of_its_generator() -> None:
    def draw(seed: int) -> Batch:
        return filled().sample(3, Sampling(5, 1, 1), np.random.default_rng(seed))

    assert same(draw(0)._asdict(), draw(0)._asdict())
    assert not same(draw(0)._asdict(), draw(1)._asdict())


def test_growing_beyond_what_was_allocated_changes_nothing() -> None:
    small, large = filled(capacity=1), filled(capacity=64)
    assert same(small.columns(), large.columns())
    assert equal_statistics(small.statistics(0.5), large.statistics(0.5))
    assert small.size == 19


def test_a_view_given_to_a_checkpoint_does_not_grow_with_the_replay() -> None:
    replay = filled(capacity=64)
    view = replay.columns()
    replay.add(*rows_of()[0])
    assert {len(column) for column in view.values()} == {19}


def test_statistics_are_those_of_numpy() -> None:
    rows = rows_of()
    observations = np.stack([row.observation for row in rows]).astype(np.float64)
    changes = np.stack([row.next_observation for row in rows]) - observations
    rewards = np.array([np.float32(row.reward) for row in rows], np.float64)
    terminal = np.array([row.terminated for row in rows])
    found = filled().statistics(0.25)
    np.testing.assert_allclose(found.observation_mean, observations.mean(0), rtol=1e-6)
    np.testing.assert_allclose(found.observation_std[:2], observations[:, :2].std(0), rtol=1e-6)
    np.testing.assert_allclose(found.delta_std[1], changes[:, 1].std(), rtol=1e-6)
    np.testing.assert_allclose(found.reward_std, rewards[~terminal].std(), rtol=1e-6)
    np.testing.assert_allclose(found.terminal_reward_scale, np.sqrt(np.mean(rewards[terminal] ** 2)), rtol=1e-6)
    np.testing.assert_allclose(found.return_scale, np.sqrt(np.mean(rewards**2)), rtol=1e-6)
    assert found.progress == 0.25
    assert {np.asarray(value).dtype for value in found} == {np.dtype(np.float32)}


def test_what_never_changes_has_the_scale_one() -> None:
    found = filled().statistics(0.0)
    assert found.observation_std[2] == 1  # always 3
    assert found.delta_std[0] == 1 and found.delta_std[2] == 1  # always 1, always 0
    nothing = np.zeros(3, np.float32), np.zeros(2, np.float32), 0.0, np.zeros(3, np.float32)
    still = filled([Row(*nothing, False, False), Row(*nothing, True, False)]).statistics(0.0)
    assert (still.reward_std, still.terminal_reward_scale, still.return_scale) == (1, 1, 1)


def test_a_constant_far_from_zero_is_still_constant() -> None:
    def at(value: float) -> Row:
        place = np.full(3, value, np.float32)
        return Row(place, np.zeros(2, np.float32), 1.0, place, False, False)

    found = filled([at(1e4 + 1 / 3)] * 1000).statistics(0.0)
    np.testing.assert_array_equal(found.observation_std, np.ones(3))
    assert found.reward_std == 1 and found.return_scale == 1


def test_terminal_rewards_do_not_widen_the_scale_of_the_others() -> None:
    place = np.zeros(3, np.float32), np.zeros(2, np.float32)
    rewards = [(1.0, False), (2.0, False), (-100.0, True), (3.0, False)]
    found = filled([Row(*place, reward, place[0], end, False) for reward, end in rewards]).statistics(0.0)
    np.testing.assert_allclose(found.reward_std, np.std([1, 2, 3]), rtol=1e-6)
    assert found.terminal_reward_scale == 100


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["observation", "action", "reward", "next_observation"])
def test_what_is_not_finite_is_refused_and_leaves_no_trace(field: str, bad: float) -> None:
    replay, row = filled(), rows_of()[0]
    value = bad if field == "reward" else np.full_like(getattr(row, field), bad)
    before, statistics = {name: column.copy() for name, column in replay.columns().items()}, replay.statistics(0.0)
    with pytest.raises(ValueError, match="not finite"):
        replay.add(*row._replace(**{field: value}))
    assert same(before, replay.columns())
    assert equal_statistics(statistics, replay.statistics(0.0))


def test_a_reward_too_large_for_float32_does_not_become_an_infinity() -> None:
    replay = filled()
    with pytest.raises(ValueError, match="not finite"):
        replay.add(*rows_of()[0]._replace(reward=1e39))
    assert replay.size == 19


def test_a_rebuilt_replay_has_the_same_bytes_and_statistics() -> None:
    replay = filled()
    back = Replay.from_columns({name: column.copy() for name, column in replay.columns().items()})
    assert same(back.columns(), replay.columns())
    assert equal_statistics(back.statistics(0.3), replay.statistics(0.3))
    assert back.episode_open and len(back.open_episode()[1]) == 5
    for grown in (replay, back):
        grown.add(*rows_of()[7])
    assert same(back.columns(), replay.columns())
    assert equal_statistics(back.statistics(0.3), replay.statistics(0.3))


def test_a_rebuilt_replay_keeps_an_episode_cut_short_apart_from_the_next() -> None:
    rows = rows_of((3, 2), ("open", "open"))
    replay = filled(rows[:3])
    replay.close_episode()
    for row in rows[3:]:
        replay.add(*row)
    back = Replay.from_columns(replay.columns())
    assert same(back.columns(), replay.columns())
    assert len(back.open_episode()[1]) == 2
    np.testing.assert_array_equal(back.windows(np.array([3]), Sampling(1, 1, 1)).valid, [[0, 1]])


def test_rewards_are_rebuilt_though_they_were_float64_when_they_came() -> None:
    row = rows_of()[0]
    replay = filled([row._replace(reward=reward) for reward in (0.1, 1 / 3, 1e-9, 12345.678901)])
    assert equal_statistics(Replay.from_columns(replay.columns()).statistics(0.0), replay.statistics(0.0))


@pytest.mark.parametrize(
    "damage",
    [
        {"reward": None},
        {"start": None},
        {"reward": np.zeros(3, np.float32)},
        {"start": np.zeros(3, np.int64)},
        {"observation": np.zeros(19, np.float32)},
        {"next_observation": np.zeros((19, 5), np.float32)},
        {"observation": np.full((19, 3), np.nan, np.float32)},
    ],
    ids=["no reward", "no start", "short reward", "short start", "flat", "wide", "nan"],
)
def test_columns_that_are_not_a_replay_are_refused_in_one_line(damage: dict[str, Any]) -> None:
    columns = {name: value for name, value in (filled().columns() | damage).items() if value is not None}
    with pytest.raises(UserError, match="these are not the steps") as caught:
        Replay.from_columns(columns)
    assert "\n" not in str(caught.value)


def test_closing_an_episode_truncates_it_once() -> None:
    replay = filled()
    replay.close_episode()
    assert not replay.episode_open
    assert replay.columns()["truncated"][-1] and not replay.columns()["terminated"][-1]
    before = {name: column.copy() for name, column in replay.columns().items()}
    replay.close_episode()
    assert same(before, replay.columns())
    assert [len(part) for part in replay.open_episode()] == [0, 0, 0]
    replay.add(*rows_of()[0])
    assert replay.columns()["start"][-1] == 19


def test_closing_an_empty_replay_does_nothing() -> None:
    replay = Replay(3, 2)
    replay.close_episode()
    assert replay.size == 0 and not replay.episode_open
    assert [part.shape for part in replay.open_episode()] == [(0, 3), (0, 2), (0, 3)]


def test_the_open_episode_is_what_has_not_ended() -> None:
    rows = rows_of()
    observations, actions, after = filled().open_episode()
    np.testing.assert_array_equal(observations, [row.observation for row in rows[14:]])
    np.testing.assert_array_equal(actions, [row.action for row in rows[14:]])
    np.testing.assert_array_equal(after, [row.next_observation for row in rows[14:]])


def test_demonstrations_alone_are_drawn_where_the_sampling_says_so() -> None:
    replay = filled()
    replay.demonstrated = 5
    only = replay.sample(40, Sampling(10, 0, 1, demonstrated=True), np.random.default_rng(0))
    assert set(only.observation[..., 0, 0].ravel()) == {0, 1, 2, 3, 4}
    every = replay.sample(40, Sampling(10, 0, 1), np.random.default_rng(0))
    assert every.observation[..., 0, 0].max() > 4


def test_the_newest_steps_alone_are_drawn_where_the_sampling_says_so() -> None:
    newest = {row.observation[0] for row in rows_of()[-3:]}
    for most, expected in ((3, newest), (10_000, {row.observation[0] for row in rows_of()})):
        drawn = filled().sample(40, Sampling(10, 0, 1, newest=most), np.random.default_rng(0))
        assert set(drawn.observation[..., 0, 0].ravel()) == expected
    window = filled().sample(40, Sampling(10, 2, 1, newest=3), np.random.default_rng(0))
    assert window.observation[..., 0, 0].min() < min(newest)  # what came before is still remembered


@pytest.mark.parametrize(
    ("newest", "terminations", "rows"),
    [
        (3, 1, [*range(5, 12), 16, 17, 18]),
        (3, 2, [*range(4), *range(5, 12), 16, 17, 18]),
        (3, 9, [*range(4), *range(5, 12), 16, 17, 18]),
        (10, 1, [*range(5, 19)]),
        (19, 2, [*range(19)]),
    ],
)
def test_the_last_steps_before_terminations_outlast_those_around_them(
    newest: int, terminations: int, rows: list[int]
) -> None:
    sampling = Sampling(25, 0, 1, newest=newest, terminations=terminations)
    drawn = filled().sample(400, sampling, np.random.default_rng(0)).observation[..., 0, 0]
    found, counts = np.unique(drawn, return_counts=True)
    assert found.tolist() == rows
    assert np.abs(counts / 10_000 - 1 / len(rows)).max() < 0.01  # each as often as any other


def test_of_a_long_episode_that_terminated_only_the_last_steps_stay() -> None:
    replay = filled(rows_of((200, 5), ("terminated", "open")))
    drawn = replay.sample(400, Sampling(10, 0, 1, newest=5, terminations=1), np.random.default_rng(0))
    assert set(drawn.observation[..., 0, 0].ravel()) == set(range(150, 205))


def test_while_the_newest_steps_hold_enough_terminations_draws_are_what_they_were() -> None:
    ends = filled().sample(40, Sampling(10, 0, 2, newest=14, terminations=1), np.random.default_rng(0))
    before = filled().sample(40, Sampling(10, 0, 2, newest=14), np.random.default_rng(0))
    assert all(np.array_equal(a, b) for a, b in zip(ends, before, strict=True))


def test_kept_and_held_out_steps_are_apart_and_together_all() -> None:
    replay = Replay(1, 1)
    for row in range(23):
        replay.add(np.float32([row]), np.float32([0]), float(row), np.float32([row + 1]), False, False)
    drawn = {}
    for part in ("all", "kept", "held-out"):
        batch = replay.sample(40, Sampling(25, 0, 1, part=part), np.random.default_rng(0))
        drawn[part] = set(batch.reward.ravel().astype(int).tolist())
    assert drawn["held-out"] == {4, 9, 14, 19}
    assert drawn["kept"] == drawn["all"] - drawn["held-out"] == set(range(23)) - {4, 9, 14, 19}


def test_demonstrated_steps_are_not_counted_as_the_run_s() -> None:
    replay = Replay(1, 1)
    for row in range(5):
        replay.add(np.float32([row]), np.float32([0]), 0.0, np.float32([row + 1]), False, False)
    replay.demonstrated = 2
    assert replay.statistics(0.0).steps == 3


def test_a_replay_too_small_to_hold_steps_out_gives_one_that_it_has() -> None:
    replay = Replay(1, 1)
    replay.add(np.float32([0]), np.float32([0]), 7.0, np.float32([1]), False, False)
    batch = replay.sample(1, Sampling(3, 0, 1, part="held-out"), np.random.default_rng(0))
    assert (batch.reward == 7).all()


def test_extending_puts_episodes_behind_and_closes_an_open_one_before() -> None:
    replay, other = filled(), filled()
    replay.extend(other.columns())
    columns = replay.columns()
    assert replay.size == 38
    assert columns["truncated"][18] and columns["start"][19] == 19
    np.testing.assert_array_equal(columns["start"][19:], other.columns()["start"] + 19)
    assert len(replay.open_episode()[1]) == 5


def test_types_are_checked_here() -> None:
    with pytest.raises(TypeCheckError):
        filled().statistics("0")  # type: ignore[arg-type]
