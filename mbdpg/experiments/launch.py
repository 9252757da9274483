"""Many pieces of work at once, on this machine's cores or on a Ray cluster; what dies is taken up again."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import multiprocessing
import os
import re
import signal
import socket
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from mbdpg.experiments.stopping import Stop
from mbdpg.interfaces import UserError, require

ATTEMPTS = 3
"""Times that a piece of work is begun whose process dies."""

FAILED = 1
"""Exit status of work that raised, which would do so again."""

POLL_SECONDS = 0.5
ALIVE = "alive"
"""File beside the logs that every process of this machine's holds while it lives."""
PLATFORM = "JAX_PLATFORMS"
LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""0 has Ray listen on loopback alone, else on all interfaces. It reads it as it is imported: once in a process."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@runtime_checkable
class Work(Protocol):
    """One piece, pickled to where it is done. Called again after its process died, it goes on from what is on disk."""

    @property
    def name(self) -> str:
        """Unique; also that of its log."""

    def finished(self) -> bool: ...

    def __call__(self, should_stop: Callable[[], bool]) -> None: ...


@dataclass(frozen=True)
class Local:
    """This machine: processes that share its cores evenly, each held to its own."""

    workers: int

    def __post_init__(self) -> None:
        require(self.workers >= 1, f"--workers is {self.workers}, expected at least 1")


@dataclass(frozen=True)
class Ray:
    """A Ray cluster whose nodes share the file system; without an address one on this machine, closed to others."""

    address: str | None = None
    gpus: bool = False
    """Whether every piece of work gets a GPU, else a core."""


def launch(
    works: Sequence[Work],
    engine: Local | Ray,
    *,
    logs: Path,
    say: Callable[[str], None],
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, str]:
    """Do all that is not finished, in order, as many at once as the engine has room for.

    Args:
        works: pieces of work, no two of which may write to the same files.
        engine: where.
        logs: folder for what each piece prints.
        say: called with a line of text whenever a piece ends.
        should_stop: asked often; when it says yes, everything running is asked to save and end.

    Returns:
        Why pieces failed, by name; the others are finished, unless it was stopped.
    """
    due = [work for work in works if not work.finished()]
    logs.mkdir(parents=True, exist_ok=True)
    if not due:
        return {}
    if isinstance(engine, Local):
        _await_orphans(logs, say, should_stop)
        return _Pool(engine.workers, logs, say).run(due, should_stop)
    return _on_ray(due, engine, logs, say, should_stop)


def cores() -> list[int]:
    """Those that this process may use; none where nobody says."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def log_of(work: Work, logs: Path) -> Path:
    """The file that gets what a piece of work prints."""
    return logs / f"{re.sub(r'[^A-Za-z0-9.=-]+', '-', work.name)}.log"


def _await_orphans(logs: Path, say: Callable[[str], None], should_stop: Callable[[], bool]) -> None:
    """Let processes whose parent was killed notice it and save; until then their runs are in use."""
    said = False
    with open(logs / ALIVE, "ab") as file:
        while not should_stop():
            try:
                return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if not said:
                    say("waiting for the processes of a run that was killed to save and end")
                said = True
                time.sleep(POLL_SECONDS)


class _Pool:
    """A process per piece of work: nothing leaks from one to the next, and a death costs one attempt."""

    def __init__(self, workers: int, logs: Path, say: Callable[[str], None]):
        self._logs, self._say = logs, say
        self._context = multiprocessing.get_context("spawn")  # JAX has threads of its own: never fork
        self._free = [cores()[slot::workers] or cores() for slot in range(workers)]
        self._running: dict[BaseProcess, tuple[Work, list[int]]] = {}

    def run(self, works: Sequence[Work], should_stop: Callable[[], bool]) -> dict[str, str]:
        try:
            return self._run(works, should_stop)
        finally:  # where an error ends it, its processes save and end too
            for process in self._running:
                process.terminate()
            for process in self._running:
                process.join()

    def _run(self, works: Sequence[Work], should_stop: Callable[[], bool]) -> dict[str, str]:
        waiting, begun, failures, stopping = deque(works), Counter[str](), dict[str, str](), False
        while self._running or (waiting and not stopping):
            while waiting and self._free and not stopping:
                work = waiting.popleft()
                begun[work.name] += 1
                self._start(work, self._free.pop(0))
            for process, work in self._ended():
                if work.finished():
                    self._say(f"{work.name}: done")
                    continue
                if stopping:
                    continue
                problem = self._problem(process, work)
                if process.exitcode != FAILED and begun[work.name] < ATTEMPTS:
                    self._say(f"{work.name}: {problem}; going on where it was")
                    waiting.append(work)
                    continue
                failures[work.name] = problem if process.exitcode == FAILED else f"{problem}, {ATTEMPTS} times"
                self._say(f"{work.name}: failed, {failures[work.name]}")
            if should_stop() and not stopping:
                stopping = True
                for process in self._running:
                    process.terminate()
        return failures

    def _problem(self, process: BaseProcess, work: Work) -> str:
        """Why a piece is not finished though its process has ended."""
        status = process.exitcode or 0
        if status == FAILED:
            return _last_line(log_of(work, self._logs)) or "it says no more than its log"
        return f"its process died ({signal.Signals(-status).name if status < 0 else f'status {status}'})"

    def _start(self, work: Work, cores: list[int]) -> None:
        process = self._context.Process(target=_in_process, args=(work, cores, log_of(work, self._logs)))
        own = dict.fromkeys(THREADS, str(max(len(cores), 1)))
        with _environment(own | {PLATFORM: os.environ.get(PLATFORM, "cpu")}):
            process.start()
        self._running[process] = (work, cores)

    def _ended(self) -> list[tuple[BaseProcess, Work]]:
        """Those that have ended since; waits a moment for one."""
        wait([process.sentinel for process in self._running], timeout=POLL_SECONDS)
        ended = [(process, work) for process, (work, _) in self._running.items() if process.exitcode is not None]
        for process, _ in ended:
            self._free.append(self._running.pop(process)[1])
        return ended


def _in_process(work: Work, cores: list[int], log: Path) -> None:
    parent = os.getppid()
    with open(log, "a", encoding="utf-8") as file, open(log.with_name(ALIVE), "ab") as alive, Stop() as stop:
        fcntl.flock(alive, fcntl.LOCK_SH)
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
        # A signal for all of a terminal or of a group is the parent's to pass on, once: a second one would not wait.
        os.setpgid(0, 0)
        if cores:
            os.sched_setaffinity(0, cores)  # before XLA counts them
        try:
            work(lambda: stop() or os.getppid() != parent)
        except Exception as error:
            if not isinstance(error, UserError):
                traceback.print_exc()
            print(f"mbdpg: {' '.join(str(error).split())}", file=sys.stderr)
            sys.exit(FAILED)


def _on_ray(
    works: Sequence[Work], engine: Ray, logs: Path, say: Callable[[str], None], should_stop: Callable[[], bool]
) -> dict[str, str]:
    ray, stop_file = _connected(engine.address), logs / f"stop-{os.getpid()}-{time.time_ns()}"
    try:
        require(not engine.gpus or ray.cluster_resources().get("GPU", 0) > 0, "--gpus, but the cluster has none")
        # A process of its own for each, as on one machine; Ray itself begins what died with it again.
        options: dict[str, Any] = {"num_cpus": 1, "num_gpus": int(engine.gpus), "max_calls": 1}
        options |= {} if engine.gpus else {"runtime_env": {"env_vars": {PLATFORM: os.environ.get(PLATFORM, "cpu")}}}
        task = ray.remote(**options, max_retries=ATTEMPTS - 1)(_as_task)
        running = {task.remote(work, log_of(work, logs), stop_file): work for work in works}
        failures: dict[str, str] = {}
        while running:
            if should_stop() and not stop_file.exists():
                stop_file.touch()  # what has not begun ends at once, what has saves first
            for reference in ray.wait(list(running), timeout=POLL_SECONDS)[0]:
                work = running.pop(reference)
                try:
                    problem = ray.get(reference)
                except ray.exceptions.RayError as error:
                    problem = f"{type(error).__name__}: {str(error).splitlines()[0]}"
                if problem:
                    failures[work.name] = problem
                if problem or work.finished():
                    say(f"{work.name}: " + (f"failed, {problem}" if problem else "done"))
        return failures
    finally:
        ray.shutdown()
        stop_file.unlink(missing_ok=True)


def _as_task(work: Work, log: Path, stop_file: Path) -> str | None:
    """Do it, in a worker of Ray's; returns why it failed, if it did."""
    if work.finished():  # by an attempt whose worker died afterwards
        return None
    with open(log, "a", encoding="utf-8") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        try:
            work(stop_file.exists)
        except Exception as error:
            traceback.print_exc()
            return str(error)
    return None


def _connected(address: str | None) -> Any:
    """Ray itself, connected to a cluster or, without an address, to a node begun here."""
    where = "local" if address is None else address
    own = {LOOPBACK: "0"} if where == "local" else {}
    try:
        with _environment(own):
            import ray
    except ImportError as error:
        raise UserError("--engine ray needs Ray, which is not installed: pip install 'mbdpg[ray]'") from error
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if found := re.fullmatch(r"([^/]+):([0-9]{1,5})", where):
        try:  # Ray would go on asking for minutes
            socket.create_connection((found[1], int(found[2])), timeout=10).close()
        except (OSError, OverflowError) as error:
            raise UserError(f"--address is {where}, where nothing answers: {error}") from error
    try:
        with _environment(own):
            ray.init(where, log_to_driver=False, logging_level=logging.ERROR, include_dashboard=False if own else None)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise UserError(f"--address is {where}, where no Ray cluster answers: {error}") from error
    finally:
        for number, handler in handlers.items():  # of which Ray took one
            signal.signal(number, handler)
    return ray


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Environment variables for processes started meanwhile."""
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.is_file() else []
    return next((line.removeprefix("mbdpg: ") for line in reversed(lines) if line.strip()), "")
