"""A run that was killed, stopped or damaged, and resumed, leaves the bytes of one that was left alone."""

from __future__ import annotations

import dataclasses
import json
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from mbdpg.agents import td3
from mbdpg.experiments import origin, resuming, run
from mbdpg.experiments.config import EnvOptions, RunConfig
from mbdpg.interfaces import EnvSpec, Step, UserError
from mbdpg.storage.array_file import read_array_file
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.loop import Schedule

Start = Callable[..., "subprocess.Popen[str]"]
LUNAR = "LunarLanderContinuous-v3"
STEPS = 400


def contents(folder: Path) -> dict[str, Any]:
    """Everything that a run leaves but for what depends on the clock: by file name, bytes or JSON."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_file() or name.startswith("tensorboard/") or name in ("lock", "timings.jsonl", "config.json"):
            continue
        found[name] = path.read_bytes()
        if path.suffix == ".json":
            found[name] = json.loads(path.read_text())
        if path.name == "facts.json":
            del found[name]["recorder"]["offsets"]["timings.jsonl"], found[name]["clock"]
        if path.name == "manifest.json":  # has the hash of facts.json
            found[name]["files"] = [file for file in found[name]["files"] if file["name"] != "facts.json"]
    return found


def check_equal(found: Path, expected: Path) -> None:
    left, right = contents(found), contents(expected)
    assert left.keys() == right.keys()
    assert {f"checkpoints/{STEPS:09d}/state.safetensors", "metrics.jsonl", "policy/best.safetensors"} <= left.keys()
    assert [name for name in left if left[name] != right[name]] == []


def rows(folder: Path) -> int:
    path = folder / "metrics.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def finish(program: subprocess.Popen[str], status: int = 0) -> str:
    _, stderr = program.communicate()
    assert program.returncode == status, stderr
    return stderr


def kill_after(program: subprocess.Popen[str], folder: Path, count: int, seconds: float) -> None:
    """Wait for a number of rows of metrics, then some moments, then kill -9."""
    while rows(folder) < count and program.poll() is None:
        time.sleep(0.002)
    time.sleep(seconds)
    program.send_signal(signal.SIGKILL)
    program.communicate()


@pytest.fixture(scope="session")
def reference(
    mbdpg_command: Start, trained: Path, flags: dict[str, tuple[str, ...]], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str, str], Path]:
    """Runs that nobody disturbed, each made once."""
    made = {("td3", "Pendulum-v1"): trained}

    def folder(algorithm: str, env: str) -> Path:
        if (algorithm, env) not in made:
            out = tmp_path_factory.mktemp("reference")
            run = ("train", env, *flags[algorithm], "--steps", str(STEPS), "--out", out)
            finish(mbdpg_command(*run))
            made[algorithm, env] = out / "seed-0"
        return made[algorithm, env]

    return folder


EVERY_CASE = [("td3", "Pendulum-v1"), ("td3", LUNAR), ("mbdpg", "Pendulum-v1"), ("mbdpg", LUNAR)]


@pytest.mark.parametrize(
    ("algorithm", "env", "kills"),
    [
        ("td3", LUNAR, [5]),
        ("sac", "Pendulum-v1", [4]),
        pytest.param("mbpo", LUNAR, [5], marks=pytest.mark.slow),
        ("pets", "Pendulum-v1", [4]),
        ("mbdpg", "Pendulum-v1", [4]),
        *(pytest.param(*case, [0, 2, 4, 6, 8], marks=pytest.mark.slow) for case in EVERY_CASE),
    ],
)
def test_killed_at_random_moments_and_resumed_it_ends_with_the_same_bytes(
    mbdpg_command: Start, reference: Any, flags: Any, tmp_path: Path, algorithm: str, env: str, kills: list[int]
) -> None:
    expected = reference(algorithm, env)
    folder, seed = tmp_path / "seed-0", time.time_ns()
    chance = random.Random(seed)
    print(f"moments are drawn from seed {seed}")
    begin = ("train", env, *flags[algorithm], "--steps", str(STEPS), "--out", tmp_path)
    program = mbdpg_command(*begin)
    for count in kills:
        kill_after(program, folder, count, chance.uniform(0, 0.2))
        saved = (folder / "checkpoints").is_dir()
        if not saved:  # there is nothing to go on from
            shutil.rmtree(folder, ignore_errors=True)
        program = mbdpg_command(*(("resume", folder) if saved else begin))
    finish(program)
    check_equal(folder, expected)
    if env == LUNAR:  # its episodes end early, so that some ended before the cuts and some were open
        assert json.loads((expected / "metrics.jsonl").read_text().splitlines()[-1])["train/episodes"] >= 3


def test_sigterm_saves_says_how_to_go_on_and_a_second_process_is_kept_out_meanwhile(
    mbdpg_command: Start, reference: Any, flags: Any, tmp_path: Path
) -> None:
    folder = tmp_path / "seed-0"
    program = mbdpg_command("train", "Pendulum-v1", *flags["td3"], "--steps", str(STEPS), "--out", tmp_path)
    while rows(folder) < 3:
        time.sleep(0.002)
    program.send_signal(signal.SIGSTOP)  # else it might be done before the second one looks
    said = finish(mbdpg_command("resume", folder), status=1)
    assert said.count("\n") == 1
    assert f"{folder} is in use by pid {program.pid} on host" in said
    program.send_signal(signal.SIGTERM)
    program.send_signal(signal.SIGCONT)
    said = finish(program, status=143)
    assert "mbdpg: saving, then stopping" in said
    assert said.endswith(f"mbdpg: saved; go on with: mbdpg resume {tmp_path}\n")
    assert rows(folder) < rows(reference("td3", "Pendulum-v1"))
    finish(mbdpg_command("resume", tmp_path))
    check_equal(folder, reference("td3", "Pendulum-v1"))


def test_ctrl_c_exits_with_130_and_a_second_one_ends_at_once(mbdpg_command: Start, flags: Any, tmp_path: Path) -> None:
    begin = ("train", "Pendulum-v1", *flags["td3"], "--steps", "100000", "--out")
    once, twice = mbdpg_command(*begin, tmp_path / "once"), mbdpg_command(*begin, tmp_path / "twice")
    while rows(tmp_path / "once" / "seed-0") < 3 or rows(tmp_path / "twice" / "seed-0") < 3:
        time.sleep(0.002)
    once.send_signal(signal.SIGINT)
    twice.send_signal(signal.SIGSTOP)  # both signals are there before it can save
    twice.send_signal(signal.SIGINT)
    twice.send_signal(signal.SIGTERM)
    twice.send_signal(signal.SIGCONT)
    said = finish(once, status=130)
    assert f"mbdpg: saved; go on with: mbdpg resume {tmp_path / 'once'}\n" in said and "Traceback" not in said
    twice.communicate()
    assert twice.returncode in (130, 143)
    newest = sorted((tmp_path / "twice" / "seed-0" / "checkpoints").iterdir())[-1]
    assert (newest / "manifest.json").exists()


def test_a_damaged_newest_checkpoint_is_said_loudly_and_the_run_still_ends_with_the_same_bytes(
    mbdpg_command: Start, trained: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "seed-0"
    shutil.copytree(trained, folder)
    newest = folder / "checkpoints" / f"{STEPS:09d}" / "state.safetensors"
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 1
    newest.write_bytes(data)
    said = finish(mbdpg_command("resume", folder))
    assert f"WARNING: skipping checkpoint {STEPS:09d}: {newest} has changed since it was written" in said
    check_equal(folder, trained)


# In this process, with an environment of our own: what does not need a kill.


class Toy:
    """Three observations, episodes of ten steps."""

    spec = EnvSpec("Toy-v0", observation_size=3, action_size=1, episode_limit=10, reference_return=None)
    frames_per_second = 50.0

    def __init__(self, fault: Callable[[], None] = lambda: None) -> None:
        self._fault = fault
        self._place, self._taken = np.zeros(3), 0

    def reset(self, *, seed: int) -> np.ndarray:
        self._place, self._taken = np.random.default_rng(seed).normal(size=3), 0
        return self._place.astype(np.float32)

    def step(self, action: np.ndarray) -> Step:
        self._fault()
        self._place, self._taken = self._place * 0.9 + 0.1 * float(action[0]), self._taken + 1
        return Step(self._place.astype(np.float32), -float(np.abs(self._place).sum()), False, self._taken == 10)

    def render(self) -> np.ndarray:
        raise NotImplementedError

    def close(self) -> None:
        pass


TOY = RunConfig(
    "Toy-v0",
    td3.Config(width=4, batch_size=4, random_steps=20),
    Schedule(steps=40, cycle=10, evaluate_every=20, evaluation_episodes=1, log_every=20, checkpoint_every=20),
)


@pytest.fixture(scope="module")
def toys(toy: Any) -> Iterator[None]:
    with toy.learned_by_toys():
        yield


@pytest.fixture(scope="module")
def toy_run(toys: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run.train(TOY, seeds=[0], out=tmp_path_factory.mktemp("toy"), make_env=Toy)[0]


@pytest.mark.parametrize("devices", [1, 2])
def test_seeds_in_one_process_leave_the_bytes_that_each_leaves_alone(
    toy_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, devices: int
) -> None:
    there = jax.local_devices()[:devices]
    assert len(there) == devices
    monkeypatch.setattr(jax, "local_devices", lambda: there)
    first, second = run.train(TOY, seeds=[0, 3], out=tmp_path / "both", make_env=Toy)
    (alone,) = run.train(TOY, seeds=[3], out=tmp_path / "alone", make_env=Toy)
    for found, expected in ((first, toy_run), (second, alone)):
        left, right = contents(found), contents(expected)
        assert left.keys() == right.keys() and [name for name in left if left[name] != right[name]] == []
    assert contents(first)["metrics.jsonl"] != contents(second)["metrics.jsonl"]


def test_seeds_that_were_begun_at_once_go_on_at_once_and_leave_the_bytes_of_an_undisturbed_run(
    toy_run: Path, tmp_path: Path
) -> None:
    reached: list[int] = []
    run.train(
        TOY,
        seeds=[0, 3],
        out=tmp_path / "a",
        make_env=Toy,
        on_update=lambda update: reached.append(update.env_steps),
        should_stop=lambda: bool(reached) and reached[-1] >= 30,
    )
    ahead = run.train(TOY, seeds=[5], out=tmp_path / "a", make_env=Toy)[0]
    going: list[tuple[list[str], int]] = []

    def watch(runs: Any, config: RunConfig, env_steps: int) -> Any:
        going.append(([path.name for path in runs], env_steps))
        return lambda update: None

    resuming.resume([tmp_path / "a" / "seed-0", ahead, tmp_path / "a" / "seed-3"], make_env=Toy, watch=watch)
    (both, begun), alone = going
    assert (both, begun) == (["seed-0", "seed-3"], 30) and alone == (["seed-5"], 40)
    whole = run.train(TOY, seeds=[3], out=tmp_path / "b", make_env=Toy)[0]
    for found, expected in ((tmp_path / "a" / "seed-0", toy_run), (tmp_path / "a" / "seed-3", whole)):
        # The stop left a checkpoint of its own; replay chunks are cut at every one.
        left, right = (
            {name: value for name, value in contents(run).items() if name.split("/")[0] in ("metrics.jsonl", "policy")}
            | {"state": contents(run)["checkpoints/000000040/state.safetensors"]}
            for run in (found, expected)
        )
        assert left.keys() == right.keys() and [name for name in left if left[name] != right[name]] == []


def test_a_stop_in_one_run_begins_none_of_those_that_would_go_on_after_it(toys: None, tmp_path: Path) -> None:
    short = dataclasses.replace(TOY, schedule=dataclasses.replace(TOY.schedule, steps=20))
    first, second = (run.train(one, seeds=[i], out=tmp_path, make_env=Toy)[0] for i, one in enumerate((TOY, short)))
    going: list[str] = []

    def watch(runs: Any, config: RunConfig, env_steps: int) -> Any:
        going.extend(path.name for path in runs)
        return lambda update: None

    resuming.resume([first, second], make_env=Toy, steps=60, watch=watch, should_stop=lambda: bool(going))
    assert going == ["seed-0"]


def edited(source: Path, target: Path, **changes: Any) -> Path:
    """A copy of a run with another config.json; a change to None takes the field out."""
    shutil.copytree(source, target)
    whole = json.loads((target / "config.json").read_text())
    whole["run"] = {name: value for name, value in (whole["run"] | changes).items() if value is not None}
    (target / "config.json").write_text(json.dumps(whole))
    return target


def test_config_json_has_everything_that_decided_the_run(toy_run: Path) -> None:
    config = RunFolder.open(toy_run).config
    assert RunConfig.from_json(config) == TOY
    assert config["seed"] == 0 and config["custom_env"] is True
    assert {"commit", "machine"} <= config.keys()


def test_a_longer_run_begins_where_the_shorter_ended(toy_run: Path, tmp_path: Path) -> None:
    folder = edited(toy_run, tmp_path / "longer")
    before = (folder / "metrics.jsonl").read_bytes()
    with pytest.raises(UserError, match="--steps is 20, but .*longer has 40 behind it; expected at least as many"):
        resuming.resume([folder], make_env=Toy, steps=20)
    resuming.resume([folder], make_env=Toy, steps=60)
    assert (folder / "metrics.jsonl").read_bytes().startswith(before)
    assert (folder / "checkpoints" / "000000060").is_dir()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"algorithm": "ppo"}, "config.json has algorithm 'ppo', expected mbdpg, td3, sac, pets, mbpo"),
        ({"algorithm": ["td3"]}, "config.json has algorithm"),
        ({"env": None}, "does not say which environment"),
        ({"agent": None}, "config.json has no agent"),
        (
            {"agent": {"width": 4}},
            "config.json does not fit this version of mbdpg, but that of its commit",
        ),
        ({"seed": "0"}, "has seed '0' in its config.json"),
        ({"seed": -1}, "has seed -1"),
        ({"agent": dataclasses.asdict(TOY.agent) | {"width": "4"}}, 'agent.width = "4", expected a whole number'),
        ({"agent": dataclasses.asdict(TOY.agent) | {"width": 0}}, "--width is 0, expected a number above 0"),
        (
            {"agent": dataclasses.asdict(TOY.agent) | {"width": 8}},
            "the checkpoint does not fit this configuration: actor/mlp/hidden/0/weight is float32[3, 4], "
            "expected float32[3, 8]",
        ),
        ({"demonstrations": 3}, "config.json has odd demonstrations"),
        (
            {"env_options": dataclasses.asdict(TOY.env_options) | {"max_episode_steps": 1.5}},
            "env_options.max_episode_steps = 1.5, expected a whole number or null",
        ),
    ],
    ids=lambda value: "" if isinstance(value, dict) else value[:40],
)
def test_a_changed_config_is_refused_in_one_line(
    toy_run: Path, tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    folder = edited(toy_run, tmp_path / "changed", **changes)
    with (folder / "metrics.jsonl").open("a") as file:  # a row after the checkpoint, as of a run that was killed
        file.write('{"kind": "train", "env_steps": 50}\n')
    before = contents(folder)
    with pytest.raises(UserError) as caught:
        resuming.resume([folder], make_env=Toy)
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert "checkpoint does not fit" in said or str(folder) in str(caught.value)
    assert contents(folder) == before


def test_one_damaged_seed_stops_its_folder_and_the_way_on_is_said(toy_run: Path, tmp_path: Path) -> None:
    """It was named, and how to go on with the others was not."""
    whole, damaged = edited(toy_run, tmp_path / "whole"), edited(toy_run, tmp_path / "damaged", agent=None)
    before = contents(whole)
    with pytest.raises(UserError, match="damaged cannot .*config.json has no agent.*; so none was resumed: the others"):
        resuming.resume([whole, damaged], make_env=Toy, steps=60)
    assert contents(whole) == before


def test_another_environment_than_the_run_s_is_refused(toy_run: Path, tmp_path: Path) -> None:
    class Wider(Toy):
        spec = dataclasses.replace(Toy.spec, observation_size=4)

    with pytest.raises(UserError, match="does not fit this configuration"):
        resuming.resume([edited(toy_run, tmp_path / "run")], make_env=Wider)


def test_a_run_folder_never_decides_that_code_is_imported(toy_run: Path, tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / "hostile.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    options = dataclasses.asdict(EnvOptions(allow_import=True))
    folder = edited(toy_run, tmp_path / "run", env="hostile:Toy-v0", env_options=options, custom_env=False)
    with pytest.raises(UserError, match="would run the code of the module hostile"):
        resuming.resume([folder])


def test_a_run_that_could_not_begin_leaves_no_folder(toys: None, tmp_path: Path) -> None:
    (tmp_path / "new" / "seed-1").mkdir(parents=True)
    (tmp_path / "new" / "seed-1" / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match="seed-1 is not empty"):
        run.train(TOY, seeds=[0, 1], out=tmp_path / "new", make_env=Toy)
    assert [path.name for path in (tmp_path / "new").rglob("*")] == ["seed-1", "mine.txt"]

    made = iter([Toy()])

    def make() -> Toy:
        try:
            return next(made)
        except StopIteration:
            raise OSError("the simulator's licence is in use") from None

    with pytest.raises(OSError, match="licence"):
        run.train(TOY, seeds=[0], out=tmp_path / "a" / "b", make_env=make)
    assert not (tmp_path / "a").exists()


def test_an_environment_that_fails_for_good_keeps_the_checkpoint_to_go_on_from(toys: None, tmp_path: Path) -> None:
    taken, broken = [0], [True]

    def fault() -> None:
        taken[0] += 1
        if broken[0] and taken[0] > 55:  # of which 20 are evaluations
            raise RuntimeError("simulator gone")

    with pytest.raises(UserError, match="failed 10 times in a row .* continue with mbdpg resume"):
        run.train(TOY, seeds=[0], out=tmp_path, make_env=lambda: Toy(fault))
    broken[0] = False
    resuming.resume([tmp_path / "seed-0"], make_env=lambda: Toy(fault))
    assert (tmp_path / "seed-0" / "checkpoints" / "000000040").is_dir()


def test_a_run_whose_first_evaluation_fails_still_keeps_its_best_policy(
    toys: None, tmp_path: Path, capsys: Any
) -> None:
    taken = [0]

    def fault() -> None:
        taken[0] += 1
        if taken[0] == 5:  # in the evaluation at step 0
            raise RuntimeError("simulator gone")

    (folder,) = run.train(TOY, seeds=[0], out=tmp_path, make_env=lambda: Toy(fault))
    first = json.loads((folder / "metrics.jsonl").read_text().splitlines()[0])
    assert (first["eval/return_mean"], first["eval/returns"], first["eval/faults"]) == (None, [], 1)
    assert "evaluation episode dropped" in capsys.readouterr().err
    returns = [json.loads(line).get("eval/return_mean") for line in (folder / "metrics.jsonl").read_text().splitlines()]
    _, facts = read_array_file(folder / "policy" / "best.safetensors", "policy")
    assert facts["return_mean"] == max(value for value in returns if value is not None)


@pytest.mark.parametrize("seeds", [[], [0, 0], [-1], [2**31]], ids=str)
def test_seeds_that_are_none_are_refused(seeds: list[int], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="seeds are"):
        run.train(TOY, seeds=seeds, out=tmp_path / "run", make_env=Toy)
    assert not (tmp_path / "run").exists()


def test_seeds_may_be_numpys(toys: None, tmp_path: Path) -> None:
    """They ended in a TypeError of JSON's."""
    (folder,) = run.train(TOY, seeds=np.arange(2, 3), out=tmp_path, make_env=Toy)
    assert RunFolder.open(folder).config["seed"] == 2


@pytest.mark.parametrize("ours", [True, False])
def test_a_commit_is_noted_only_of_our_own_checkout(ours: bool, tmp_path: Path, monkeypatch: Any) -> None:
    """Installed within somebody's repository, runs were noted as made by that one's commit."""
    package = tmp_path / ".venv" / "mbdpg"
    package.mkdir(parents=True)
    (package / "origin.py").touch()
    (tmp_path / "mine.txt").touch()
    identity = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (
        ("init", "-q"),
        ("add", "-f", "mine.txt", *([".venv"] * ours)),
        (*identity, "commit", "-qm", "first"),
    ):
        subprocess.run(["git", "-C", tmp_path, *words], check=True)
    monkeypatch.setattr(origin, "__file__", str(package / "origin.py"))
    assert (origin.origin()["commit"] is not None) == ours


def test_a_policy_is_refused_where_it_does_not_fit(toy_run: Path, tmp_path: Path) -> None:
    spec = dataclasses.replace(Toy.spec, id="Other-v0", observation_size=4)
    with pytest.raises(UserError, match="is for 3 observation and 1 action entries, but Other-v0 has 4 and 1"):
        run.load_policy(toy_run, spec=spec)
    folder = edited(toy_run, tmp_path / "run")
    (folder / "policy" / "latest.safetensors").write_bytes(b"no policy")
    with pytest.raises(UserError, match="latest.safetensors is not a safetensors file"):
        run.load_policy(folder)
    shutil.rmtree(folder / "policy")
    with pytest.raises(UserError, match="has no latest.safetensors yet"):
        run.load_policy(folder)


def test_a_resume_on_another_machine_says_what_changed(toy_run: Path, tmp_path: Path, capsys: Any) -> None:
    machine = RunFolder.open(toy_run).config["machine"]
    other = machine | {"cpu": "abacus", "devices": "1 × abacus", "versions": machine["versions"] | {"jax": "0.0.1"}}
    resuming.resume([edited(toy_run, tmp_path / "other", machine=other)], make_env=Toy)
    assert "other was begun elsewhere, with other cpu, devices, jax; its results may differ" in capsys.readouterr().err
    resuming.resume([edited(toy_run, tmp_path / "same")], make_env=Toy)
    assert capsys.readouterr().err == ""


def test_what_an_environment_raises_when_it_is_made_is_not_blamed_on_the_checkpoint(
    toy_run: Path, tmp_path: Path
) -> None:
    def make() -> Toy:
        raise ValueError("no such track")

    with pytest.raises(ValueError, match="no such track"):
        resuming.resume([edited(toy_run, tmp_path / "run")], make_env=make)
