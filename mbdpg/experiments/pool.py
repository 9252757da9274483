"""Pieces of work on this machine: a process for each, held to its own cores; one that dies is taken up again."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from mbdpg.experiments.launch import ATTEMPTS, PLATFORM, POLL_SECONDS, Work, environment, log_of
from mbdpg.experiments.stopping import Stop
from mbdpg.interfaces import UserError, one_line, require

FAILED = 1
"""Exit status of work that raised, which would do so again."""

ALIVE = "alive"
"""File beside the logs that every process of this machine's holds while it lives."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> list[int]:
    """Those that this process may use; none where nobody says."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


@dataclass(frozen=True)
class Local:
    """This machine: processes that share its cores evenly, each held to its own."""

    workers: int = len(cores()) or os.cpu_count() or 1

    def __post_init__(self) -> None:
        require(self.workers >= 1, f"--workers is {self.workers}, expected at least 1")

    @property
    def seeds_together(self) -> bool:
        """No: on cores each has a program of its own."""
        return False

    @property
    def flags(self) -> Sequence[str]:
        """None: it is the default."""
        return ()

    def run(
        self, works: Sequence[Work], logs: Path, say: Callable[[str], None], should_stop: Callable[[], bool]
    ) -> dict[str, str]:
        """See `launch`."""
        _await_orphans(logs, say, should_stop)
        return _Pool(self.workers, logs, say).run(works, should_stop)


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
        process = self._context.Process(target=_in_process, args=(os.getpid(), work, cores, log_of(work, self._logs)))
        own = dict.fromkeys(THREADS, str(max(len(cores), 1)))
        with environment(own | {PLATFORM: os.environ.get(PLATFORM, "cpu")}):
            process.start()
        self._running[process] = (work, cores)

    def _ended(self) -> list[tuple[BaseProcess, Work]]:
        """Those that have ended since; waits a moment for one."""
        wait([process.sentinel for process in self._running], timeout=POLL_SECONDS)
        ended = [(process, work) for process, (work, _) in self._running.items() if process.exitcode is not None]
        for process, _ in ended:
            self._free.append(self._running.pop(process)[1])
        return ended


def _in_process(parent: int, work: Work, cores: list[int], log: Path) -> None:
    """Do it, unless and until the parent is gone, be it before this process had read what its work is."""
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
            print(f"mbdpg: {one_line(str(error))}", file=sys.stderr)
            sys.exit(FAILED)


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.is_file() else []
    return next((line.removeprefix("mbdpg: ") for line in reversed(lines) if line.strip()), "")
