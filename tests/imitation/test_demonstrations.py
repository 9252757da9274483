"""Demonstrations: what is recorded, what of a stranger's file is believed, and what training makes of them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbdpg.agents import mbdpg
from mbdpg.envs import episode_seed
from mbdpg.experiments import resuming, run
from mbdpg.experiments.config import RunConfig
from mbdpg.imitation.demonstrations import Demonstrations, record
from mbdpg.interfaces import EnvSpec, Phase, Sampling, Step, UserError
from mbdpg.storage.array_file import write_array_file
from mbdpg.training.loop import Schedule


class Lottery:
    """Episodes of four steps; their return, 0 to 3, follows from the seed. Observes step, return and seed."""

    spec = EnvSpec("Lottery-v0", observation_size=3, action_size=1, episode_limit=4, reference_return=2.0)
    frames_per_second = 50.0

    def __init__(self, fault: Callable[[int], None] = lambda seed: None) -> None:
        self._fault = fault
        self._seed = self._taken = 0

    def reset(self, *, seed: int) -> np.ndarray:
        self._seed, self._taken = seed, 0
        self._fault(seed)
        return self._seen()

    def step(self, action: np.ndarray) -> Step:
        self._taken += 1
        return Step(self._seen(), float(self._seed % 4) / 4, False, self._taken == 4)

    def render(self) -> np.ndarray:
        raise NotImplementedError

    def close(self) -> None:
        pass

    def _seen(self) -> np.ndarray:
        return np.array([self._taken, self._seed % 4, self._seed % 1000], np.float32)


def half(observation: np.ndarray) -> np.ndarray:
    return np.full(1, 0.5, np.float32)


SEEDS = [episode_seed(0, "expert", episode) for episode in range(40)]


def recorded(**changes: Any) -> Demonstrations:
    settings = {"episodes": 3, "success_return": 2.0, "expert_env_steps": 1000, "seed": 0} | changes
    return record(Lottery(), half, **settings)


def test_only_successes_are_kept_and_every_step_is_counted() -> None:
    found = recorded()
    returns = [float(seed % 4) for seed in SEEDS]
    tried = next(n for n in range(40) if sum(value >= 2 for value in returns[:n]) == 3)
    assert 3 < tried < 12  # some were no success
    assert found.facts["returns"] == [value for value in returns[:tried] if value >= 2]
    assert found.facts["tried"] == tried
    assert found.expert_env_steps == 1000 + 4 * tried
    assert found.replay.size == 12 and found.env == "Lottery-v0"
    columns = found.replay.columns()
    assert (columns["observation"][:, 1] >= 2).all()
    np.testing.assert_array_equal(columns["truncated"], [False, False, False, True] * 3)
    np.testing.assert_array_equal(columns["start"], np.repeat([0, 4, 8], 4))


def test_without_a_success_the_best_return_and_a_way_out_are_said() -> None:
    with pytest.raises(
        UserError, match="none of 4 episodes .* the best return was 3.0, expected at least 9.0"
    ) as caught:
        recorded(episodes=1, success_return=9.0)
    assert "--success-return" in str(caught.value) and "\n" not in str(caught.value)


def test_where_the_environment_fails_in_every_episode_the_expert_is_not_blamed() -> None:
    def fault(seed: int) -> None:
        raise FloatingPointError("nan")

    with pytest.raises(UserError, match="^Lottery-v0 failed in all 4 episodes of the expert"):
        record(Lottery(fault), half, episodes=1, success_return=2.0, expert_env_steps=0, seed=0)


def test_fewer_successes_than_asked_for_are_kept_after_four_times_as_many_trials() -> None:
    won = [seed % 4 == 3 for seed in SEEDS]
    count = next(count for count in range(1, 10) if 0 < sum(won[: 4 * count]) < count)
    wins = sum(won[: 4 * count])
    found = recorded(episodes=count, success_return=3.0)
    assert (found.facts["tried"], found.facts["returns"]) == (4 * count, [3.0] * wins)


def test_an_episode_in_which_the_environment_fails_is_tried_and_not_kept(capsys: pytest.CaptureFixture[str]) -> None:
    good = next(episode for episode in range(40) if SEEDS[episode] % 4 >= 2)

    def fault(seed: int) -> None:
        if seed == SEEDS[good]:
            raise RuntimeError("simulator gone")

    whole = recorded(episodes=2)
    found = record(Lottery(fault), half, episodes=2, success_return=2.0, expert_env_steps=0, seed=0)
    assert found.facts["returns"][0] == whole.facts["returns"][1]
    assert found.facts["tried"] > whole.facts["tried"]
    assert "dropped" in capsys.readouterr().err


def test_a_file_gives_back_what_was_saved(tmp_path: Path) -> None:
    found = recorded()
    found.save(tmp_path / "new" / "demonstrations.safetensors")
    back = Demonstrations.load(tmp_path / "new" / "demonstrations.safetensors", Lottery.spec)
    for name, column in found.replay.columns().items():
        assert back.replay.columns()[name].tobytes() == column.tobytes()
    assert (back.env, back.expert_env_steps) == (found.env, found.expert_env_steps)
    assert back.facts["success_return"] == 2.0 and back.facts["returns"] == found.facts["returns"]


def columns_of(count: int = 4) -> dict[str, np.ndarray]:
    return {name: column[:count].copy() for name, column in recorded().replay.columns().items()}


def nan_at(name: str) -> Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]:
    def change(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        columns[name].flat[0] = np.nan
        return columns

    return change


COST = {"expert_env_steps": 5, "env": "Lottery-v0"}


@pytest.mark.parametrize(
    ("change", "facts", "said"),
    [
        (nan_at("observation"), COST, "not finite"),
        (nan_at("action"), COST, "not finite"),
        (nan_at("reward"), COST, "not finite"),
        (nan_at("next_observation"), COST, "not finite"),
        (lambda c: c | {"action": c["action"] * 3}, COST, r"actions outside \[-1, 1\]"),
        (lambda c: {k: v[:0] for k, v in c.items()}, COST, "no steps; expected at least one successful episode"),
        (lambda c: {k: v for k, v in c.items() if k != "reward"}, COST, "reward"),
        (lambda c: c | {"reward": c["reward"][:2]}, COST, "."),
        (lambda c: c | {"observation": c["observation"][:, 0]}, COST, "."),
        (lambda c: c | {"start": np.full(4, 10**12)}, COST, "."),
        (lambda c: c | {"start": np.full(4, -7)}, COST, "."),
        (
            lambda c: c | {k: c[k][:, :2] for k in ("observation", "next_observation")},
            COST,
            "has 2 observation and 1 action entries, but Lottery-v0 has 3 and 1; expected demonstrations of Lottery-v0",
        ),
        (lambda c: c, COST | {"env": "Other-v0"}, "has demonstrations of Other-v0, expected Lottery-v0"),
        (lambda c: c, {"env": "Lottery-v0"}, "does not say how many steps its expert took"),
        (lambda c: c, COST | {"expert_env_steps": -1}, "does not say how many steps"),
        (lambda c: c, COST | {"expert_env_steps": "many"}, "does not say how many steps"),
    ],
    ids=[
        *("nan observation", "nan action", "nan reward", "nan next observation", "large actions", "empty", "no reward"),
        *(
            "short reward",
            "flat",
            "far starts",
            "early starts",
            "other sizes",
            "other env",
            "no cost",
            "negative cost",
            "odd cost",
        ),
    ],
)
def test_a_strangers_file_is_refused_in_one_line(tmp_path: Path, change: Any, facts: dict[str, Any], said: str) -> None:
    path = tmp_path / "demonstrations.safetensors"
    write_array_file(path, "demonstrations", change(columns_of()), facts)
    with pytest.raises(UserError, match=said) as caught:
        Demonstrations.load(path, Lottery.spec)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "is not a safetensors file"),
        (b"\x80\x04\x95cos\nsystem\n", "is not a safetensors file"),
        (b"\xff" * 8 + b"{}", "its header is over"),
        ((2).to_bytes(8, "little") + b"{}", "was not written by mbdpg"),
        ((4).to_bytes(8, "little") + b"nope", "is not valid JSON"),
    ],
    ids=["empty", "pickle", "huge header", "foreign", "garbage"],
)
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path: Path, data: bytes, said: str) -> None:
    path = tmp_path / "demonstrations.safetensors"
    path.write_bytes(data)
    with pytest.raises(UserError, match=said) as caught:
        Demonstrations.load(path, Lottery.spec)
    assert "\n" not in str(caught.value) and "expected an mbdpg demonstrations file" in str(caught.value)


def test_a_policy_is_not_taken_for_demonstrations(tmp_path: Path) -> None:
    path = tmp_path / "latest.safetensors"
    write_array_file(path, "policy", {"mean": np.zeros(3, np.float32)}, {})
    with pytest.raises(UserError, match="is 'mbdpg-policy', expected an mbdpg demonstrations file"):
        Demonstrations.load(path, Lottery.spec)


def test_where_no_file_can_be_written_one_line_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write .*; choose another place or make room"):
        recorded().save(tmp_path / "file" / "demonstrations.safetensors")


def test_training_from_demonstrations_clones_first_and_counts_their_cost(toy: Any, tmp_path: Path) -> None:
    file = tmp_path / "demonstrations.safetensors"
    recorded().save(file)
    clone = Sampling(4, 0, 1, demonstrated=True)

    def make_agent(config: RunConfig, spec: EnvSpec) -> Any:
        agent = toy.ToyAgent(spec)
        agent.phases = (
            Phase("cloning", 0.0, clone, 6, agent.update),
            Phase("improving", 1.0, Sampling(4, 0, 1), 0, agent.update),
        )
        return agent

    config = RunConfig(
        "Lottery-v0",
        mbdpg.Config(random_steps=20),
        Schedule(steps=40, cycle=10, evaluate_every=20, evaluation_episodes=1, log_every=20, checkpoint_every=20),
        demonstrations=str(file),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "make_agent", make_agent)
        (with_them,) = run.train(config, seeds=[0], out=tmp_path / "with", make_env=Lottery)
        config = dataclasses.replace(config, demonstrations=None)
        (without,) = run.train(config, seeds=[0], out=tmp_path / "without", make_env=Lottery)

    def facts(folder: Path) -> Any:
        return json.loads((folder / "checkpoints" / "000000040" / "facts.json").read_text())

    def rows(folder: Path) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]

    assert facts(with_them)["updates"] == {"cloning": 6, "improving": 20}
    assert facts(without)["updates"] == {"cloning": 0, "improving": 20}
    cost = recorded().expert_env_steps
    assert [row["expert_env_steps"] for row in rows(with_them) if row["kind"] == "eval"] == [cost] * 3
    assert [row["expert_env_steps"] for row in rows(without) if row["kind"] == "eval"] == [0] * 3
    assert rows(with_them)[-1]["env_steps"] == 40  # those of the expert are no steps of this run
    assert facts(with_them)["demonstrated"] == 12 and facts(without)["demonstrated"] == 0
    # Gone on with, it needs the file no longer.
    file.unlink()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "make_agent", make_agent)
        resuming.resume([with_them], make_env=Lottery, steps=60)
    assert rows(with_them)[-1]["env_steps"] == 60


def test_demonstrations_that_cannot_be_used_leave_no_run_folder(toy: Any, tmp_path: Path) -> None:
    config = RunConfig("Lottery-v0", demonstrations=str(tmp_path / "missing"))
    with pytest.raises(UserError, match="missing is missing; expected an mbdpg demonstrations file"):
        run.train(config, seeds=[0], out=tmp_path / "run", make_env=Lottery)
    assert not (tmp_path / "run").exists()
