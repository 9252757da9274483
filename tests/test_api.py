"""The library: train with one's own config and environment, act, watch, go on."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import mbdpg
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.collector import Collector


class Slider(gymnasium.Env[Any, Any]):
    """Push a point to the middle."""

    observation_space = gymnasium.spaces.Box(-4, 4, (1,))
    action_space = gymnasium.spaces.Box(-2, 2, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-2, 2, 1)
        return self.place, {}

    def step(self, action: np.ndarray) -> Any:
        self.place = np.clip(self.place + 0.1 * action, -4, 4)
        return self.place, -float(abs(self.place[0])), False, False, {}


def slider() -> gymnasium.Env[Any, Any]:
    return gymnasium.wrappers.TimeLimit(Slider(), 10)


SCHEDULE = mbdpg.Schedule(
    steps=40, cycle=10, evaluate_every=20, evaluation_episodes=2, log_every=20, checkpoint_every=20
)
CONFIG = mbdpg.TD3Config(width=3, random_steps=20)


class OwnConfig(mbdpg.TD3Config):
    """Which no run folder could hold."""


@pytest.fixture(scope="module", autouse=True)
def toys(toy: Any) -> Iterator[None]:
    with toy.learned_by_toys():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    (folder,) = mbdpg.train(slider, config=CONFIG, schedule=SCHEDULE, out=tmp_path_factory.mktemp("api"))
    return folder


def test_one_s_own_environment_and_config_are_trained_watched_and_used_in_a_few_lines(tmp_path: Path) -> None:
    seen: list[mbdpg.Update] = []
    config = mbdpg.MBDPGConfig(width=3, random_steps=20)
    (folder,) = mbdpg.train(
        slider, config=config, schedule=SCHEDULE, seeds=[7], out=tmp_path, on_evaluation=seen.append
    )
    assert folder == tmp_path / "seed-7"
    assert [update.env_steps for update in seen] == [0, 20, 40]
    assert [len(update.evaluation[0].returns) for update in seen if update.evaluation] == [2, 2, 2]
    policy = mbdpg.load_policy(folder)
    action = policy(np.zeros(1, np.float32))
    assert action.shape == (1,) and np.abs(action).max() <= 1
    found = mbdpg.evaluate(slider, policy, episodes=3)
    assert len(found.returns) == 3 and found.lengths == [10, 10, 10] and found.faults == 0


def test_several_seeds_have_a_folder_each_and_a_place_in_what_a_callback_sees(tmp_path: Path) -> None:
    seen: list[mbdpg.Update] = []
    folders = mbdpg.train(
        slider, config=CONFIG, schedule=SCHEDULE, seeds=[3, 5], out=tmp_path, on_evaluation=seen.append
    )
    assert [path.name for path in folders] == ["seed-3", "seed-5"]
    for update in seen:
        assert update.evaluation is not None and len(update.evaluation) == len(update.train_returns) == 2
    assert seen[-1].evaluation[0].returns != seen[-1].evaluation[1].returns  # type: ignore[index]


def test_a_run_with_one_s_own_environment_is_gone_on_with(folder: Path) -> None:
    seen: list[mbdpg.Update] = []
    with pytest.raises(mbdpg.UserError, match=r"made in code; resume it with mbdpg.resume\(..., env=...\)"):
        mbdpg.resume(folder)
    mbdpg.resume(folder, env=slider, steps=60, on_evaluation=seen.append)
    assert [update.env_steps for update in seen] == [60]
    with pytest.raises(mbdpg.UserError, match="--steps is 20, but .*seed-0 has 60 behind it"):
        mbdpg.resume(folder, env=slider, steps=20)


def test_the_best_policy_is_that_of_the_best_evaluation(tmp_path: Path) -> None:
    seen: list[tuple[float, int]] = []

    def watch(update: mbdpg.Update) -> None:
        assert update.evaluation is not None
        seen.append((float(np.mean(update.evaluation[0].returns)), update.env_steps))

    (folder,) = mbdpg.train(slider, config=CONFIG, schedule=SCHEDULE, out=tmp_path, on_evaluation=watch)
    best, latest = mbdpg.load_policy(folder, best=True), mbdpg.load_policy(folder)
    same = all(np.array_equal(best.arrays[name], latest.arrays[name]) for name in latest.arrays)
    assert same == (max(seen)[1] == 40)


def test_evaluation_is_repeatable_and_its_seed_decides(folder: Path) -> None:
    policy = mbdpg.load_policy(folder)
    first, again, other = (mbdpg.evaluate(slider, policy, episodes=3, seed=seed) for seed in (0, 0, 1))
    assert first.returns == again.returns != other.returns


def test_a_policy_may_be_any_function_and_what_it_raises_comes_through() -> None:
    found = mbdpg.evaluate(slider, lambda observation: -np.sign(observation), episodes=2)
    np.testing.assert_array_equal(found.steps.columns()["action"], -np.sign(found.steps.columns()["observation"]))
    with pytest.raises(ZeroDivisionError):
        mbdpg.evaluate(slider, lambda observation: observation / (1 // 0))


def test_exploration_follows_the_reference_return_that_one_s_own_environment_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[float | None] = []

    def progress(collector: Collector, reference: float | None) -> float:
        seen.append(reference)
        return 0.0

    monkeypatch.setattr(Collector, "progress", progress)
    for reference in None, -3.5:
        seen.clear()
        out = tmp_path / str(reference)
        (folder,) = mbdpg.train(slider, config=CONFIG, schedule=SCHEDULE, out=out, reference_return=reference)
        mbdpg.resume(folder, env=slider, steps=60)
        assert len(seen) >= 4 and set(seen) == {reference}


@pytest.mark.parametrize("bad", [0.0, np.full(1, np.nan), np.zeros(2)], ids=["number", "nan", "long"])
def test_a_policy_s_bad_action_is_not_the_environment_s_fault(bad: Any) -> None:
    """Every episode was dropped as one in which the environment failed."""
    with pytest.raises(mbdpg.UserError, match="^slider was not stepped: the policy's action has"):
        mbdpg.evaluate(slider, lambda observation: bad)


def test_an_old_id_is_recorded_as_what_was_run(tmp_path: Path) -> None:
    """Reports put Hopper-v3 and Hopper-v5, which it had become, into two tables."""
    (folder,) = mbdpg.train("Hopper-v3", config=CONFIG, schedule=SCHEDULE, out=tmp_path)
    assert RunFolder.open(folder).config["env"] == "Hopper-v5"


def test_a_function_that_makes_the_environment_will_do(tmp_path: Path) -> None:
    (folder,) = mbdpg.train(
        lambda: gymnasium.make("Pendulum-v1", max_episode_steps=15), config=CONFIG, schedule=SCHEDULE, out=tmp_path
    )
    assert mbdpg.load_policy(folder).observation_size == 3


def test_a_registered_environment_is_named_by_its_id(tmp_path: Path) -> None:
    (folder,) = mbdpg.train("Pendulum-v1", config=CONFIG, schedule=SCHEDULE, out=str(tmp_path))
    mbdpg.resume(str(folder), steps=60)
    found = mbdpg.evaluate("Pendulum-v1", mbdpg.load_policy(str(folder)), episodes=1)
    assert found.lengths == [200]


def test_what_an_environment_lacks_is_said_before_anything_is_written(tmp_path: Path) -> None:
    class Discrete(Slider):
        action_space = gymnasium.spaces.Discrete(2)

    with pytest.raises(mbdpg.UserError, match="Discrete has the action space"):
        mbdpg.train(Discrete, config=CONFIG, schedule=SCHEDULE, out=tmp_path / "run")
    with pytest.raises(mbdpg.UserError, match="Slider has no step limit.* gymnasium.wrappers.TimeLimit"):
        mbdpg.train(Slider, config=CONFIG, schedule=SCHEDULE, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_callback_that_raises_ends_the_run_which_can_be_gone_on_with(tmp_path: Path) -> None:
    def stop(update: mbdpg.Update) -> None:
        if update.env_steps == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mbdpg.train(slider, config=CONFIG, schedule=SCHEDULE, out=tmp_path, on_evaluation=stop)
    seen: list[int] = []
    mbdpg.resume(tmp_path / "seed-0", env=slider, on_evaluation=lambda update: seen.append(update.env_steps))
    assert seen == [40]


def test_everything_public_is_there_and_explained() -> None:
    for name in mbdpg.__all__:
        assert getattr(mbdpg, name).__doc__


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"env": gymnasium.Env()}, "env is Env, expected a Gymnasium id or a function"),
        ({"env": None}, "env is NoneType, expected a Gymnasium id or a function"),
        ({"seeds": 3}, r"seeds is 3, expected a list of numbers, as in \[3\]"),
        ({"config": "td3"}, "config is str, expected an MBDPGConfig"),
        ({"config": mbdpg.TD3Config}, "config is Config, expected an MBDPGConfig"),
        ({"config": OwnConfig()}, "config is OwnConfig, expected an MBDPGConfig"),
    ],
    ids=["an environment made already", "nothing", "one seed", "an algorithm's name", "a class", "one's own config"],
)
def test_what_is_no_environment_list_or_config_is_refused_in_one_line(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    given = {"env": "Pendulum-v1", "out": tmp_path} | changes
    train: Any = inspect.unwrap(mbdpg.train)  # without the types' check, which only tests have
    with pytest.raises(mbdpg.UserError, match=said):
        train(**given)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"env": slider()}, "env is TimeLimit, expected a Gymnasium id or a function"),
        ({"episodes": 0}, "episodes is 0, expected at least 1"),
        ({"seed": -1}, "seed is -1, expected at least 0"),
    ],
    ids=["an environment made already", "no episode", "a negative seed"],
)
def test_an_evaluation_that_cannot_be_is_refused_in_one_line(changes: dict[str, Any], said: str) -> None:
    given = {"env": slider, "policy": lambda observation: np.zeros(1)} | changes
    evaluate: Any = inspect.unwrap(mbdpg.evaluate)
    with pytest.raises(mbdpg.UserError, match=said):
        evaluate(**given)
