"""A real Ray cluster of two nodes on this machine, one of whose workers is killed in the middle of a run."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbdpg.agents import td3
from mbdpg.experiments import reproduce as module
from mbdpg.experiments.cluster import Ray
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.launch import launch
from mbdpg.experiments.pool import Local
from mbdpg.experiments.reproduce import Training, reproduce
from mbdpg.experiments.search import Search
from mbdpg.experiments.studies import Cell, Panel, Study
from mbdpg.experiments.sweep import LAST, Trial, sweep
from mbdpg.interfaces import UserError
from mbdpg.training.loop import Schedule

pytestmark = [pytest.mark.extras, pytest.mark.timeout(600)]

SCHEDULE = Schedule(
    steps=3000, evaluate_every=500, evaluation_episodes=1, log_every=100, checkpoint_every=100, cycle=50
)
CONFIG = RunConfig("Pendulum-v1", td3.Config(width=8, batch_size=8, random_steps=100, updates_per_step=0.1), SCHEDULE)


@contextlib.contextmanager
def started(*nodes: tuple[str, ...]) -> Iterator[str]:
    """The address of a cluster of such nodes on this machine, with a core each; other clusters are left alone.

    Without tokens: Ray's nodes would ask for one where an earlier cluster left it in the home folder, and its clients
    not bring it.
    """
    ray = str(Path(sys.executable).parent / "ray")
    common = ("--block", "--node-ip-address=127.0.0.1", "--num-cpus=1", "--disable-usage-stats")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"127.0.0.1:{port}"
    # Not pytest's own folder: the names of sockets may not be long.
    with tempfile.TemporaryDirectory() as place, contextlib.ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "disabled")
        head = ("--head", f"--port={port}", "--include-dashboard=false", f"--temp-dir={place}")
        for number, flags in enumerate(nodes):
            joining = head if number == 0 else (f"--address={address}",)
            process = subprocess.Popen(
                [ray, "start", *joining, *common, *flags], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            stack.callback(process.wait, 60)
            stack.callback(process.terminate)
        yield wait_for(address, len(nodes))


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """A head and a worker node."""
    with started((), ()) as address:
        yield address


def wait_for(address: str, nodes: int) -> str:
    """The address, once so many nodes have joined."""
    state = "import ray, sys; ray.init(sys.argv[1], log_to_driver=False); print(len(ray.nodes()))"
    for _ in range(20):
        done = subprocess.run([sys.executable, "-c", state, address], capture_output=True, text=True, check=False)
        if done.stdout.strip().endswith(str(nodes)):
            return address
        time.sleep(1)
    raise AssertionError(done.stdout + done.stderr)


def rows(run: Path) -> list[dict[str, Any]]:
    path = run / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_a_killed_worker_costs_nothing_but_time(cluster: str, kill_in_the_middle: Any, tmp_path: Path) -> None:
    works = [Training(CONFIG, (seed,), tmp_path / "ray" / "Pendulum-v1" / "td3") for seed in range(3)]
    killed = kill_in_the_middle(works[0].out / "seed-0", 500)
    said: list[str] = []
    failures = launch(works, Ray(cluster), logs=tmp_path / "logs", say=said.append)
    assert killed and failures == {} and all(work.finished() for work in works)
    assert sorted(said) == [f"{work.name}: done" for work in works]
    # Every row of every run exactly once, and the killed run's are those of one that was left alone.
    alone = Training(CONFIG, (0,), tmp_path / "local" / "Pendulum-v1" / "td3")
    assert launch([alone], Local(2), logs=tmp_path / "logs", say=said.append) == {}
    for work in works:
        found = [(row["kind"], row["env_steps"]) for row in rows(work.out / f"seed-{work.seeds[0]}")]
        assert len(set(found)) == len(found) == len(rows(alone.out / "seed-0"))
    assert rows(works[0].out / "seed-0") == rows(alone.out / "seed-0")
    assert launch(works, Ray("127.0.0.1:1"), logs=tmp_path, say=said.append) == {}  # nothing is left to do


def test_asked_to_stop_each_piece_saves_and_another_time_goes_on(cluster: str, tmp_path: Path) -> None:
    endless = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SCHEDULE, steps=100_000_000))
    work = Training(endless, (0,), tmp_path / "Pendulum-v1" / "td3")
    said: list[str] = []

    def saved() -> int:
        return max((int(path.name) for path in work.runs()[0].glob("checkpoints/0*") if path.name.isdigit()), default=0)

    reached = [0]
    for _ in range(2):
        more: Callable[[], bool] = lambda: saved() > reached[-1]  # noqa: E731
        assert launch([work], Ray(cluster), logs=tmp_path / "logs", say=said.append, should_stop=more) == {}
        reached.append(saved())
    assert 0 < reached[1] < reached[2] and not work.finished() and said == []
    steps = [row["env_steps"] for row in rows(work.runs()[0]) if row["kind"] == "eval"]
    assert steps == sorted(set(steps))
    assert [path.name for path in (tmp_path / "logs").iterdir()] == ["Pendulum-v1-td3-seed-0.log"]


def test_a_piece_that_raises_is_named_and_the_others_are_done(cluster: str, tmp_path: Path) -> None:
    short = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SCHEDULE, steps=200))
    wrong = dataclasses.replace(short, env="NoSuchTask-v0")
    works = [Training(config, (0,), tmp_path / config.env / "td3") for config in (wrong, short)]
    failures = launch(works, Ray(cluster), logs=tmp_path / "logs", say=lambda line: None)
    assert list(failures) == [works[0].name] and "NoSuchTask" in failures[works[0].name]
    assert works[1].finished()


def test_no_gpus_and_no_cluster_are_said_in_one_line(cluster: str, tmp_path: Path) -> None:
    work: Callable[[str], Training] = lambda name: Training(CONFIG, (0,), tmp_path / name)  # noqa: E731
    with pytest.raises(UserError, match="--gpus, but the cluster has none"):
        launch([work("a")], Ray(cluster, gpus=True), logs=tmp_path, say=lambda line: None)
    with pytest.raises(UserError, match="--address is 127.0.0.1:1, where nothing answers"):
        launch([work("b")], Ray("127.0.0.1:1"), logs=tmp_path, say=lambda line: None)


def test_seeds_of_a_task_and_algorithm_share_a_gpu_and_one_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A GPU that is only said to be there: Ray hands it out, and JAX, which finds none, takes the processor."""
    short = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SCHEDULE, steps=500))
    wider = dataclasses.replace(short, agent=dataclasses.replace(CONFIG.agent, width=9))
    cells = (Cell("td3", short), Cell("td3 width=9", wider))
    monkeypatch.setattr(module, "study", lambda name, scale: Study(name, "nothing", (Panel("width", cells),)))
    said: list[str] = []
    with started(("--num-gpus=1", "--num-cpus=2")) as address:
        reproduce("figure-8", "quick", tmp_path, Ray(address, gpus=True), seeds=(0, 1), say=said.append)
    logs = sorted(path.name for path in (tmp_path / "logs").iterdir())
    assert logs == ["Pendulum-v1-td3-seed-0-1.log", "Pendulum-v1-td3-width=9-seed-0-1.log"]
    assert "figure-8: 2 of 2 to do" in said
    # One GPU and two cores: one after the other.
    runs = [tmp_path / "Pendulum-v1" / cell.folder.name / "seed-0" for cell in cells]
    spans = sorted([(run / name).stat().st_mtime for name in ("config.json", "metrics.jsonl")] for run in runs)
    assert spans[0][1] <= spans[1][0]
    for seed in (0, 1):
        alone = Training(short, (seed,), tmp_path / "alone")
        alone(lambda: False)
        assert rows(tmp_path / "Pendulum-v1" / "td3" / f"seed-{seed}") == rows(alone.runs()[0])


def test_a_sweep_ends_each_trial_once_though_a_worker_is_killed(
    cluster: str, kill_in_the_middle: Any, tmp_path: Path
) -> None:
    searches, said = (Search("batch_size", 2, 9),), list[str]()
    first = Trial(0, CONFIG, searches, (0,), False, tmp_path)
    killed = kill_in_the_middle(first.folder / "seed-0", 500)
    sweep(CONFIG, searches, trials=3, seeds=(0,), prune=False, out=tmp_path, engine=Ray(cluster), say=said.append)
    assert killed and "3 of 3 trials completed" in " ".join(said)
    with open(tmp_path / "sweep.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["state"] for row in table] == ["complete"] * 3 and (tmp_path / "history.png").exists()
    for number, row in enumerate(table):
        run = dataclasses.replace(first, number=number).folder / "seed-0"
        ends = [row["eval/return_mean"] for row in rows(run) if row["kind"] == "eval"]
        assert len(ends) == 7 and float(row["score"]) == pytest.approx(np.mean(ends[-LAST:]))


def family(process: int) -> list[Path]:
    """Folders in /proc of a process and of all that descend from it."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
    found = [process]
    for member in found:
        found += [child for child, parent in parents.items() if parent == member]
    return [Path("/proc") / str(member) for member in found]


def open_to_others(process: int) -> set[str]:
    """Addresses and ports, but for loopback's, at which a process or a descendant accepts connections."""
    addresses = {}
    for table in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")):
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            _, local, _, state, *rest = line.split()
            address = local.partition(":")[0]
            loopback = address.endswith("7F") if len(address) == 8 else address.endswith(("01000000", "0100007F"))
            if state == "0A" and not loopback:
                addresses[f"socket:[{rest[5]}]"] = local
    held = set()
    for member in family(process):
        with contextlib.suppress(OSError):
            held |= {addresses.get(os.readlink(file)) for file in (member / "fd").iterdir()}
    return {address for address in held if address}


def test_without_an_address_nothing_listens_to_other_machines(tmp_path: Path) -> None:
    """Every process of Ray's listened on all interfaces, though it was told to be 127.0.0.1."""
    short = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SCHEDULE, steps=200))
    work = Training(short, (0,), tmp_path / "Pendulum-v1" / "td3")
    # In a process that has not imported Ray for a cluster before.
    code = (
        "import json, pathlib, sys; from mbdpg.experiments.config import RunConfig; "
        "from mbdpg.experiments.cluster import Ray; from mbdpg.experiments.launch import launch; "
        "from mbdpg.experiments.reproduce import Training; "
        "config, out = RunConfig.from_json(json.loads(sys.argv[1])), pathlib.Path(sys.argv[2]); "
        "sys.exit(str(launch([Training(config, (0,), out)], Ray(), logs=out / 'logs', say=print) or ''))"
    )
    command = [sys.executable, "-c", code, json.dumps(short.to_json()), str(work.out)]
    found, members = set[str](), 0
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            found |= open_to_others(process.pid)
            members = max(members, len(family(process.pid)))
            time.sleep(0.1)
        assert process.stderr is not None and process.stderr.read() == "\n"
    assert work.finished() and members > 3 and not found
