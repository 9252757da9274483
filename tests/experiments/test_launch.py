"""Pieces of work in processes of their own: killed, failing, stopped."""

from __future__ import annotations

import fcntl
import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Timer
from typing import Any

import pytest

import mbdpg
from mbdpg.experiments.cluster import Ray, _as_task
from mbdpg.experiments.launch import ATTEMPTS, launch
from mbdpg.experiments.pool import ALIVE, Local
from mbdpg.interfaces import UserError

PIECES = """
import os, signal, time
from dataclasses import dataclass
from pathlib import Path

if slow := os.environ.get("SLOW_TO_READ"):
    Path(slow, f"{os.getpid()}.reading").touch()
    time.sleep(1.5)

@dataclass(frozen=True)
class Piece:
    name: str
    folder: Path
    kind: str = "good"

    def count(self):
        return len(list(self.folder.glob(self.name + ".*")))

    def finished(self):
        return (self.folder / self.name).exists()

    def __call__(self, should_stop):
        attempt = self.count() + 1
        (self.folder / f"{self.name}.{attempt}").write_text(str(sorted(os.sched_getaffinity(0))))
        print("at work", flush=True)
        if self.kind == "deadly" or (self.kind == "killed once" and attempt == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        if self.kind == "wrong":
            raise ValueError("a bad\\nnumber")
        while self.kind == "endless" and not should_stop():
            time.sleep(0.05)
        (self.folder / self.name).write_text("saved" if self.kind == "endless" else "done")
"""


@pytest.fixture
def piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes pieces of work that other processes can unpickle."""
    (tmp_path / "pieces_of_work.py").write_text(PIECES)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pieces_of_work", raising=False)
    made = importlib.import_module("pieces_of_work")
    return lambda name, kind="good": made.Piece(name, tmp_path, kind)


def test_the_dead_are_taken_up_again_and_the_failed_are_named(piece: Any, tmp_path: Path) -> None:
    (tmp_path / "before").write_text("done")
    works = [
        *(piece("before"), piece("easy"), piece("wrong", "wrong")),
        *(piece("once", "killed once"), piece("never", "deadly")),
    ]
    said: list[str] = []
    failures = launch(works, Local(2), logs=tmp_path / "logs", say=said.append)
    assert {work.name: work.count() for work in works} == {
        **{"before": 0, "easy": 1, "wrong": 1, "once": 2},
        "never": ATTEMPTS,
    }
    assert failures == {"wrong": "a bad number", "never": "its process died (SIGKILL), 3 times"}
    assert all(piece(name).finished() for name in ("before", "easy", "once"))
    assert "once: its process died (SIGKILL); going on where it was" in said and "easy: done" in said
    assert "at work" in (tmp_path / "logs" / "once.log").read_text()


def test_each_process_has_cores_of_its_own(piece: Any, tmp_path: Path) -> None:
    launch([piece("a"), piece("b")], Local(2), logs=tmp_path / "logs", say=lambda line: None)
    held = [set(numbers((tmp_path / f"{name}.1").read_text())) for name in "ab"]
    cores = os.sched_getaffinity(0)
    assert held[0] | held[1] <= cores
    assert len(cores) < 2 or not held[0] & held[1]


def numbers(text: str) -> list[int]:
    return [int(number) for number in text.strip("[]").split(",")]


def test_asked_to_stop_it_lets_each_piece_save(piece: Any, tmp_path: Path) -> None:
    works = [piece("long", "endless"), piece("waiting")]

    def begun() -> bool:
        return works[0].count() > 0

    began = time.monotonic()
    failures = launch(works, Local(1), logs=tmp_path / "logs", say=lambda line: None, should_stop=begun)
    assert failures == {} and time.monotonic() - began < 60
    assert (tmp_path / "long").read_text() == "saved"
    assert works[1].count() == 0


def test_processes_of_a_launch_that_was_killed_are_waited_for(piece: Any, tmp_path: Path) -> None:
    # Begun again at once, a study failed those pieces whose runs they still held.
    (tmp_path / "logs").mkdir()
    said: list[str] = []
    with open(tmp_path / "logs" / ALIVE, "ab") as orphan:
        fcntl.flock(orphan, fcntl.LOCK_SH)
        Timer(1.5, lambda: fcntl.flock(orphan, fcntl.LOCK_UN)).start()
        began = time.monotonic()
        assert launch([piece("a")], Local(1), logs=tmp_path / "logs", say=said.append) == {}
    assert time.monotonic() - began > 1
    assert said == ["waiting for the processes of a run that was killed to save and end", "a: done"]


LAUNCHER = """
import sys
from pathlib import Path
from mbdpg.experiments.launch import launch
from mbdpg.experiments.pool import Local
from mbdpg.experiments.stopping import Stop
from pieces_of_work import Piece

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    with Stop() as stop:
        launch([Piece("long", folder, "endless")], Local(1), logs=folder / "logs", say=print, should_stop=stop)
"""


@pytest.mark.parametrize("how", ["all of its group are asked to end", "it is killed", "it is killed early"])
def test_whatever_ends_the_launcher_its_pieces_save(piece: Any, tmp_path: Path, how: str) -> None:
    """A piece that had not been read yet when its launcher died went on for ever."""
    (tmp_path / "launcher.py").write_text(LAUNCHER)
    paths = os.pathsep.join([str(tmp_path), str(Path(mbdpg.__file__).parent.parent)])
    command = [sys.executable, str(tmp_path / "launcher.py"), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": paths, "SLOW_TO_READ": str(tmp_path) if how.endswith("early") else ""}
    program = subprocess.Popen(command, env=environment, start_new_session=True)
    if how == "it is killed early":
        waited(lambda: len(list(tmp_path.glob("*.reading"))) == 2)  # the launcher has read it, and now its piece does
    else:
        waited(lambda: piece("long").count() > 0)
    if how.startswith("it is killed"):
        program.kill()
    else:
        os.killpg(program.pid, signal.SIGTERM)
    program.wait(timeout=60)
    waited((tmp_path / "long").exists)
    assert (tmp_path / "long").read_text() == "saved"


def waited(until: Callable[[], bool]) -> None:
    began = time.monotonic()
    while not until():
        assert time.monotonic() - began < 60
        time.sleep(0.05)


def test_no_worker_and_no_ray_are_said_in_one_line(monkeypatch: pytest.MonkeyPatch, piece: Any, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--workers is 0, expected at least 1"):
        Local(0)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"needs Ray, which is not installed: pip install 'mbdpg\[ray\]'"):
        launch([piece("a")], Ray(), logs=tmp_path, say=lambda line: None)


class TaskError(RuntimeError):
    """Ray's, whose text begins with where it was raised."""

    def __init__(self, cause: Exception):
        super().__init__("\x1b[36mray::_as_task()\x1b[39m (pid=7, ip=127.0.0.1)\n  File ...")
        self.cause = cause


class Cluster:
    """In the place of the module `ray`: what it is asked for, and nothing done."""

    def __init__(self) -> None:
        self.options: dict[str, Any] = {}
        self.problem: type[BaseException] | None = None
        """Raised where work is waited for."""
        self.refused = False
        self.exceptions = type("Exceptions", (), {"RayError": RuntimeError, "RayTaskError": TaskError})
        self.task_problem: Exception | None = None

    def init(self, address: str, **options: Any) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if self.refused:
            raise ConnectionError("no")

    def cluster_resources(self) -> dict[str, float]:
        return {"GPU": 1.0}

    def remote(self, **options: Any) -> Any:
        self.options = options
        return lambda function: type("Task", (), {"remote": staticmethod(lambda *given: given)})

    def wait(self, running: list[Any], timeout: float) -> tuple[list[Any], list[Any]]:
        if self.problem:
            raise self.problem
        return running, []

    def get(self, reference: Any) -> str:
        if self.task_problem:
            raise self.task_problem
        return "not done"

    def shutdown(self) -> None: ...


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    made, before = Cluster(), signal.getsignal(signal.SIGTERM)
    monkeypatch.setitem(sys.modules, "ray", made)
    yield made
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("given", [None, "tpu"])
def test_work_on_a_cluster_takes_no_gpu_that_was_not_asked_for(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch, piece: Any, tmp_path: Path, given: str | None
) -> None:
    """Without --gpus, pieces on a node that has one would all have filled it."""
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    if given:
        monkeypatch.setenv("JAX_PLATFORMS", given)
    launch([piece("a")], Ray(), logs=tmp_path, say=lambda line: None)
    assert cluster.options["runtime_env"] == {"env_vars": {"JAX_PLATFORMS": given or "cpu"}}
    launch([piece("a")], Ray(gpus=True), logs=tmp_path, say=lambda line: None)
    assert cluster.options["num_gpus"] == 1 and "runtime_env" not in cluster.options


def test_a_cluster_that_refuses_leaves_signals_as_they_were(cluster: Cluster, piece: Any, tmp_path: Path) -> None:
    before, cluster.refused = signal.getsignal(signal.SIGTERM), True
    with pytest.raises(UserError, match="where no Ray cluster answers: no"):
        launch([piece("a")], Ray(), logs=tmp_path, say=lambda line: None)
    assert signal.getsignal(signal.SIGTERM) == before


def test_what_a_worker_raises_is_told_and_not_where(cluster: Cluster, piece: Any, tmp_path: Path) -> None:
    """As of a node that does not share the file system."""
    for problem, said in (
        (TaskError(OSError("no such\nfolder")), "OSError: no such folder"),
        (RuntimeError("the node died"), "RuntimeError: the node died"),
    ):
        cluster.task_problem = problem
        assert launch([piece("a")], Ray(), logs=tmp_path / "logs", say=lambda line: None) == {"a": said}


def test_work_that_waited_on_a_cluster_does_not_begin_after_a_stop(piece: Any, tmp_path: Path) -> None:
    """Every trial of a sweep that was stopped chose its settings first."""
    (tmp_path / "stop").touch()
    assert _as_task(piece("a"), tmp_path / "log", tmp_path / "stop") is None and piece("a").count() == 0
    assert _as_task(piece("a"), tmp_path / "log", tmp_path / "go") is None and piece("a").count() == 1


def test_an_error_leaves_no_file_that_asks_to_stop(cluster: Cluster, piece: Any, tmp_path: Path) -> None:
    cluster.problem = KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt):
        launch([piece("a")], Ray(), logs=tmp_path / "logs", say=lambda line: None, should_stop=lambda: True)
    assert list((tmp_path / "logs").iterdir()) == []
