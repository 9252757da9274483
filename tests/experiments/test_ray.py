"""A real Ray cluster of two nodes on this machine, one of whose workers is killed in the middle of a run."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mbdpg.agents import td3
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.launch import Local, Ray, launch
from mbdpg.experiments.reproduce import Training
from mbdpg.interfaces import UserError
from mbdpg.training.loop import Schedule

pytestmark = [pytest.mark.extras, pytest.mark.timeout(600)]

SCHEDULE = Schedule(
    steps=3000, evaluate_every=500, evaluation_episodes=1, log_every=100, checkpoint_every=100, cycle=50
)
CONFIG = RunConfig("Pendulum-v1", td3.Config(width=8, batch_size=8, random_steps=100, updates_per_step=0.1), SCHEDULE)


def ray_command(*arguments: str) -> None:
    command = [str(Path(sys.executable).parent / "ray"), *arguments]
    quiet = os.environ | {"RAY_DISABLE_IMPORT_WARNING": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    done = subprocess.run(command, env=quiet, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a head and a worker node on loopback, with a core each."""
    address = "127.0.0.1:26379"
    ray_command("stop", "--force")
    node = ("--node-ip-address=127.0.0.1", "--num-cpus=1", "--disable-usage-stats")
    try:
        ray_command("start", "--head", f"--port={address.split(':')[1]}", "--include-dashboard=false", *node)
        ray_command("start", f"--address={address}", *node)
        yield address
    finally:
        ray_command("stop", "--force")


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
