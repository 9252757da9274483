"""When updates, evaluations and saves are due, and that a run may stop between any two of them."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mbdpg.interfaces import Phase, Sampling, UserError
from mbdpg.training.evaluation import Evaluation
from mbdpg.training.loop import Schedule, Update
from mbdpg.training.replay import Replay

STEPS = 60


def never() -> bool:
    return False


def run(training: Any, should_stop: Callable[[], bool] = never) -> list[Update]:
    updates: list[Update] = []
    training.run(updates.append, should_stop)
    return updates


def bytes_of(arrays: dict[str, np.ndarray]) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in arrays.items()}


def rows(recorder: Any, kind: str) -> dict[int, dict[str, Any]]:
    found = [row for row in recorder.rows if row["kind"] == kind]
    assert [row["env_steps"] for row in found] == sorted({row["env_steps"] for row in found})
    return {row["env_steps"]: row for row in found}


@pytest.fixture(scope="module")
def whole(toy: Any) -> tuple[Any, list[Any], list[Update]]:
    """A run of two seeds that nobody disturbed."""
    training, recorders = toy.toy_training([0, 5])
    return training, recorders, run(training)


def test_evaluations_rows_and_checkpoints_come_when_they_are_due(whole: Any) -> None:
    training, recorders, updates = whole
    for recorder in recorders:
        assert list(rows(recorder, "eval")) == [0, 20, 40, 60]
        assert list(rows(recorder, "train")) == [0, 10, 20, 30, 40, 50, 60]
        assert [checkpoint[0] for checkpoint in recorder.checkpoints] == [0, 30, 60]
        assert [env_steps for env_steps, _ in recorder.policies] == [0, 20, 40, 60]
    assert [update.env_steps for update in updates] == list(range(0, 61, 5))
    assert [update.env_steps for update in updates if update.evaluation] == [0, 20, 40, 60]
    assert training.env_steps == 60


def test_the_budget_is_kept_to_the_step(whole: Any) -> None:
    training, _, _ = whole
    for collector in training.collectors:
        assert collector.env_steps == collector.replay.size == STEPS


def test_updates_follow_from_the_steps(whole: Any) -> None:
    _, recorders, _ = whole
    for env_steps, row in rows(recorders[1], "train").items():
        learned = max(env_steps - 20, 0)
        fitting = 7 + learned // 5 if env_steps >= 20 else 0
        assert row["gradient_steps"] == fitting + learned
    (_, arrays, facts, _) = recorders[1].checkpoints[-1]
    assert facts["updates"] == {"fitting": 15, "improving": 40}
    assert arrays["updates"] == 55


def test_a_row_has_the_means_since_the_row_before(whole: Any) -> None:
    _, recorders, _ = whole
    found = rows(recorders[0], "train")
    assert "critic/loss" not in found[10] and "critic/loss" in found[20] and "critic/loss" in found[60]
    assert found[20]["critic/loss"] != found[30]["critic/loss"]


def test_what_is_learned_is_evaluated_and_saved_and_the_behavior_collects(whole: Any) -> None:
    training, recorders, updates = whole
    learned, (behaviors, _) = training.learner.policies()[1], training.learner.behaviors()
    assert bytes_of(recorders[1].saved) == bytes_of(learned.arrays)
    played = updates[-1].evaluation[1].steps.columns()
    for observation, action in zip(played["observation"], played["action"], strict=True):
        np.testing.assert_array_equal(action, learned(observation))
    assert not np.allclose(learned(played["observation"][0]), behaviors[1](played["observation"][0]), atol=0.01)
    # Noise has a spread of 0.1, and the two policies are further apart.
    last = training.collectors[1].replay.columns()
    pairs = zip(last["observation"][-5:], last["action"][-5:], strict=True)
    assert np.mean([abs(action - behaviors[1](observation)) for observation, action in pairs]) < 0.2


def starts(evaluation: Evaluation) -> tuple[float, ...]:
    columns = evaluation.steps.columns()
    first = columns["start"] == np.arange(evaluation.steps.size)
    return tuple(columns["observation"][first, 0])


def test_evaluation_episodes_are_the_same_every_time_and_differ_between_seeds(whole: Any) -> None:
    _, _, updates = whole
    found = [[starts(evaluation) for evaluation in update.evaluation] for update in updates if update.evaluation]
    assert all(pair == found[0] for pair in found)
    assert not set(found[0][0]) & set(found[0][1])


def test_an_evaluation_row_is_the_mean_over_its_episodes(whole: Any) -> None:
    _, recorders, updates = whole
    evaluation = updates[-1].evaluation[1]
    row = rows(recorders[1], "eval")[60]
    assert row["eval/returns"] == evaluation.returns and len(evaluation.returns) == 2
    assert row["eval/return_mean"] == np.mean(evaluation.returns)
    assert row["eval/return_std"] == np.std(evaluation.returns)
    assert (row["eval/length_mean"], row["eval/faults"], row["expert_env_steps"]) == (7, 0, 0)


def test_evaluation_steps_never_reach_the_replay(whole: Any) -> None:
    training, _, updates = whole
    learned = {tuple(row) for row in training.collectors[0].replay.columns()["next_observation"]}
    evaluated = {
        tuple(row) for u in updates if u.evaluation for row in u.evaluation[0].steps.columns()["next_observation"]
    }
    assert evaluated and not learned & evaluated


@pytest.mark.parametrize("cuts", [[1], [16], [30], [44], [60], [90], [120], [3, 3, 3], [55, 2, 9]], ids=str)
def test_a_run_stopped_anywhere_and_resumed_equals_one_that_was_not(whole: Any, toy: Any, cuts: list[int]) -> None:
    _, (expected, _), _ = whole
    training, (recorder,) = toy.toy_training([0])
    for cut in [*cuts, 10**9]:
        asked = itertools.count(1)
        run(training, lambda asked=asked, cut=cut: next(asked) >= cut)
        env_steps, arrays, facts, columns = recorder.checkpoints[-1]
        kept = recorder.rows
        training, (recorder,) = toy.toy_training([0], replay=Replay.from_columns(columns))
        recorder.rows = kept
        training.restore(env_steps, [arrays], [json.loads(json.dumps(facts))])
        recorder.checkpoints.append((env_steps, arrays, facts, columns))
    assert training.env_steps == STEPS
    assert recorder.rows == expected.rows
    (_, arrays, facts, columns), (_, arrays_whole, facts_whole, columns_whole) = (
        recorder.checkpoints[-1],
        expected.checkpoints[-1],
    )
    assert bytes_of(arrays) == bytes_of(arrays_whole)
    assert facts.pop("clock").keys() == facts_whole["clock"].keys()
    assert facts == {name: fact for name, fact in facts_whole.items() if name != "clock"}
    assert bytes_of(columns) == bytes_of(columns_whole)


EVALUATION_STEPS = range(2 * 7)  # two episodes of the toy; each asks whether to stop


def test_an_evaluation_that_never_ends_is_left_when_asked_and_begun_again(whole: Any, toy: Any) -> None:
    training, (recorder,) = toy.toy_training([0])
    asked = itertools.count()
    assert run(training, lambda: next(asked) >= len(EVALUATION_STEPS) // 2) == []
    env_steps, arrays, facts, columns = recorder.checkpoints[-1]
    assert env_steps == 0 and facts["recorded"] == -1 and recorder.rows == [] and recorder.policies == []
    training, (recorder,) = toy.toy_training([0], replay=Replay.from_columns(columns))
    training.restore(env_steps, [arrays], [facts])
    run(training)
    assert recorder.rows == whole[1][0].rows


def test_a_stop_between_two_updates_is_saved_there(toy: Any) -> None:
    training, (recorder,) = toy.toy_training([0])
    asked = itertools.count(1 - len(EVALUATION_STEPS))
    updates = run(training, lambda: next(asked) >= 8)
    env_steps, _, facts, _ = recorder.checkpoints[-1]
    assert env_steps == 20 and updates[-1].env_steps == 15  # step 20 was not recorded yet
    assert 0 < facts["updates"]["fitting"] < 7
    assert facts["recorded"] == 15


def test_a_finished_run_that_is_resumed_adds_nothing(whole: Any, toy: Any) -> None:
    _, (expected, _), _ = whole
    env_steps, arrays, facts, columns = expected.checkpoints[-1]
    training, (recorder,) = toy.toy_training([0], replay=Replay.from_columns(columns))
    training.restore(env_steps, [arrays], [json.loads(json.dumps(facts))])
    assert run(training) == []
    assert recorder.rows == []
    assert bytes_of(recorder.checkpoints[-1][1]) == bytes_of(arrays)


def resumed(toy: Any, recorder: Any, steps: int, stop: Callable[[], bool] = never) -> Any:
    """The recorder of what goes on from another's last checkpoint, to as many steps."""
    env_steps, arrays, facts, columns = recorder.checkpoints[-1]
    schedule = dataclasses.replace(toy.toy_training([0])[0].schedule, steps=steps)
    training, (recorder,) = toy.toy_training([0], replay=Replay.from_columns(columns), schedule=schedule)
    training.restore(env_steps, [arrays], [facts])
    run(training, stop)
    return recorder


@pytest.mark.parametrize(("at", "kinds"), [(15, ["eval", "train"]), (10, ["eval"])])
def test_a_run_that_is_to_end_where_it_stands_is_evaluated_there_once(toy: Any, at: int, kinds: list[str]) -> None:
    """It was said to have its steps already, and its last policy was never evaluated or saved."""
    training, (stopped,) = toy.toy_training([0])
    seen: list[int] = []
    training.run(lambda update: seen.append(update.env_steps), lambda: at in seen)
    assert stopped.checkpoints[-1][0] == at
    asked = resumed(toy, stopped, at, lambda: True)  # before it is evaluated
    assert asked.rows == []
    ended = resumed(toy, asked, at)
    assert [row["kind"] for row in ended.rows] == kinds and len(ended.policies) == 1
    longer = resumed(toy, ended, 60, lambda: True)  # before it goes on
    again = resumed(toy, longer, at)
    assert again.rows == [] and again.checkpoints[-1][2]["steps"] == at


def counted(
    toy: Any, *phases: Phase, random_steps: int = 0, demonstrated: int = 0, cycle: int = 5
) -> list[dict[str, int]]:
    """Updates taken by the end of each of five cycles, the first of which the random steps may fill."""
    agent = toy.ToyAgent(toy.ToyEnv.spec, toy.ToyConfig(random_steps=random_steps))
    agent.phases = tuple(phase._replace(update=agent.update) for phase in phases)
    replay = Replay(2, 1)
    for _ in range(demonstrated):
        replay.add(np.zeros(2, np.float32), np.zeros(1, np.float32), 0.0, np.ones(2, np.float32), False, True)
    replay.demonstrated = demonstrated
    steps = 4 * cycle
    schedule = Schedule(
        steps, cycle, evaluate_every=steps, evaluation_episodes=1, log_every=cycle, checkpoint_every=cycle
    )
    training, (recorder,) = toy.toy_training([0], agent=agent, schedule=schedule, replay=replay)
    run(training)
    return [checkpoint[2]["counts"] for checkpoint in recorder.checkpoints]


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch, toy: Any) -> Callable[..., list[dict[str, int]]]:
    """As `counted`, with the counters copied at each save, before they go on."""
    save = toy.ToyRecorder.save_checkpoint

    def copy(self: Any, env_steps: int, arrays: Any, facts: dict[str, Any], replay: Any) -> None:
        save(self, env_steps, arrays, facts | {"counts": dict(facts["updates"])}, replay)

    monkeypatch.setattr(toy.ToyRecorder, "save_checkpoint", copy)
    return lambda *phases, **settings: counted(toy, *phases, **settings)


DRAW = Sampling(2, 0, 1)


def test_a_rate_below_one_update_per_cycle_is_kept_on_average(counts: Any) -> None:
    assert [count["slow"] for count in counts(Phase("slow", 0.1, DRAW))] == [0, 0, 1, 1, 2]


def test_a_rate_whose_product_is_just_below_a_whole_number_loses_no_cycle(counts: Any) -> None:
    """50 * 0.58 is 28.999999999999996: the first two cycles had 0 and 29 updates, not 29 and 58."""
    assert 50 * 0.58 < 29
    assert [count["rounded"] for count in counts(Phase("rounded", 0.58, DRAW), cycle=50)] == [0, 29, 58, 87, 116]


def test_first_updates_are_all_taken_though_they_are_not_a_multiple_of_anything(counts: Any) -> None:
    assert [count["clone"] for count in counts(Phase("clone", 0.0, DRAW, 7), random_steps=5)] == [0, 7, 7, 7, 7]
    assert [count["clone"] for count in counts(Phase("clone", 0.0, DRAW, 3), random_steps=5)] == [0, 3, 3, 3, 3]


def test_few_first_updates_are_not_lost_before_others_that_come_many_at_once(counts: Any) -> None:
    """An ensemble that had none planned and imagined untrained."""
    found = counts(Phase("few", 1.0, DRAW, 3), random_steps=5)
    assert [count["few"] for count in found] == [0, 5, 10, 15, 20]


def test_without_random_steps_learning_waits_for_the_first_transition(counts: Any) -> None:
    assert [count["now"] for count in counts(Phase("now", 1.0, DRAW, 5))] == [0, 10, 15, 20, 25]


def test_demonstrations_are_learned_from_before_the_first_step_and_only_if_there_are_any(counts: Any) -> None:
    clone = Phase("clone", 0.0, Sampling(2, 0, 1, demonstrated=True), 10)
    assert [count["clone"] for count in counts(clone, demonstrated=4)] == [10] * 5
    assert [count["clone"] for count in counts(clone)] == [0] * 5


class Failing:
    """Raises at the second step of every episode that `bad` says is one."""

    def __init__(self, bad: Callable[[int], bool]) -> None:
        self.episode, self._bad = -1, bad

    def __call__(self, step: int) -> None:
        self.episode += step == 0
        if step == 2 and self._bad(self.episode):
            raise FloatingPointError("reward nan")


def test_an_environment_that_fails_in_evaluation_does_not_kill_training(
    toy: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    training, (recorder,) = toy.toy_training(
        [0], make_env=lambda: toy.ToyEnv(Failing(lambda episode: episode % 2 == 1))
    )
    run(training)
    assert training.env_steps == STEPS
    for row in rows(recorder, "eval").values():
        assert len(row["eval/returns"]) == 1 and row["eval/faults"] == 1
        assert math.isfinite(row["eval/return_mean"]) and row["eval/length_mean"] == 7
        assert "critic/q_bias" in row
    said = capsys.readouterr().err
    assert said.count("evaluation episode dropped, Toy-v0 failed (FloatingPointError: reward nan)") == 4


@pytest.mark.parametrize("step", [0, 2])
def test_when_all_evaluation_episodes_fail_the_row_has_no_return(
    toy: Any, step: int, capsys: pytest.CaptureFixture[str]
) -> None:
    def fault(now: int) -> None:
        if now == step:
            raise FloatingPointError("nan")

    training, (recorder,) = toy.toy_training([0], make_env=lambda: toy.ToyEnv(fault))
    updates = run(training)
    assert [update.evaluation[0].returns for update in updates if update.evaluation] == [[]] * 4
    for row in rows(recorder, "eval").values():
        assert row["eval/returns"] == [] and row["eval/faults"] == 2
        assert math.isnan(row["eval/return_mean"]) and math.isnan(row["eval/return_std"])
    assert all(math.isnan(value) for _, value in recorder.policies)
    assert capsys.readouterr().err.count("dropped") == 8


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"steps": 0}, "--steps is 0, expected a number above 0"),
        ({"cycle": 0}, "cycle is 0"),
        ({"steps": 125}, "--steps is 125, expected a multiple of --cycle, 50"),
        ({"evaluate_every": 30}, "--evaluate-every is 30, expected a multiple"),
        ({"evaluation_episodes": 0}, "--evaluation-episodes is 0"),
        ({"checkpoint_every": -50}, "--checkpoint-every is -50"),
    ],
    ids=str,
)
def test_a_schedule_that_cannot_be_kept_is_refused(settings: dict[str, int], said: str) -> None:
    with pytest.raises(UserError, match=said):
        Schedule(**settings)


def test_seconds_never_run_backwards_though_somebody_sets_the_clock(toy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    wall, seconds = itertools.count(2_000_000_000, -3600), []
    monkeypatch.setattr(time, "time", lambda: float(next(wall)))
    monkeypatch.setattr(
        toy.ToyRecorder, "write", lambda self, kind, steps, values: seconds.append(values["time/seconds"])
    )
    training, _ = toy.toy_training([0])
    run(training)
    assert len(seconds) > 5 and seconds == sorted(seconds) and seconds[0] >= 0


def test_the_clock_of_a_resumed_run_goes_on_where_it_was_saved(toy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    training, (recorder,) = toy.toy_training([0])
    run(training, lambda: training.env_steps >= 16)
    env_steps, arrays, facts, columns = recorder.checkpoints[-1]
    later = {name: seconds + 3600 for name, seconds in facts["clock"].items()}
    clocks: list[dict[str, float]] = []
    monkeypatch.setattr(
        toy.ToyRecorder,
        "write",
        lambda self, kind, steps, values: clocks.append({k: v for k, v in values.items() if k.startswith("time/")}),
    )
    training, _ = toy.toy_training([0], replay=Replay.from_columns(columns))
    training.restore(env_steps, [arrays], [facts | {"clock": later}])
    run(training)
    assert len(clocks) > 2 and clocks[0].keys() == later.keys()
    for before, after in itertools.pairwise([later, *clocks]):
        assert all(before[name] <= after[name] < before[name] + 600 for name in before)


def test_seeds_that_are_resumed_together_keep_their_own_hours(toy: Any) -> None:
    """All but the first had gone on from the first one's clock."""
    training, recorders = toy.toy_training([0, 1])
    run(training, lambda: training.env_steps >= 16)
    saved = [recorder.checkpoints[-1] for recorder in recorders]
    facts = [
        fact | {"clock": {name: seconds + 3600 * hours for name, seconds in fact["clock"].items()}}
        for (_, _, fact, _), hours in zip(saved, (1, 5), strict=True)
    ]
    training, recorders = toy.toy_training([0, 1])
    training.restore(saved[0][0], [arrays for _, arrays, _, _ in saved], facts)
    training.save()
    clocks = [recorder.checkpoints[-1][2]["clock"]["time/seconds"] for recorder in recorders]
    assert [round(seconds / 3600) for seconds in clocks] == [1, 5]


def test_evaluation_is_a_plain_tuple_of_what_a_callback_needs(whole: Any) -> None:
    _, _, updates = whole
    assert isinstance(updates[0].evaluation[0], Evaluation)
    assert math.isnan(updates[0].train_returns[0])
    assert math.isfinite(updates[-1].train_returns[0])
