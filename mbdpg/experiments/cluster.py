"""Pieces of work on a Ray cluster: the only file that imports Ray."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import signal
import socket
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbdpg.experiments.launch import ATTEMPTS, PLATFORM, POLL_SECONDS, Work, environment, log_of
from mbdpg.interfaces import UserError, one_line, require

LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""0 has Ray listen on loopback alone, else on all interfaces. It reads it as it is imported: once in a process."""


@dataclass(frozen=True)
class Ray:
    """A Ray cluster whose nodes share the file system; without an address one on this machine, closed to others."""

    address: str | None = None
    gpus: bool = False
    """Whether every piece of work gets a GPU, else a core."""

    @property
    def seeds_together(self) -> bool:
        """Seeds that share a GPU are one program."""
        return self.gpus

    @property
    def flags(self) -> Sequence[str]:
        """Without the address."""
        return ("--engine ray", *(["--gpus"] * self.gpus))

    def run(
        self, works: Sequence[Work], logs: Path, say: Callable[[str], None], should_stop: Callable[[], bool]
    ) -> dict[str, str]:
        """See `launch`."""
        ray, stop_file = _connected(self.address), logs / f"stop-{os.getpid()}-{time.time_ns()}"
        try:
            require(not self.gpus or ray.cluster_resources().get("GPU", 0) > 0, "--gpus, but the cluster has none")
            # A process of its own for each, as on one machine; Ray itself begins what died with it again.
            options: dict[str, Any] = {"num_cpus": 1, "num_gpus": int(self.gpus), "max_calls": 1}
            options |= {} if self.gpus else {"runtime_env": {"env_vars": {PLATFORM: os.environ.get(PLATFORM, "cpu")}}}
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
                    except ray.exceptions.RayTaskError as error:  # its own text begins with where, in colors
                        problem = f"{type(error.cause).__name__}: {one_line(str(error.cause))}"
                    except ray.exceptions.RayError as error:
                        problem = f"{type(error).__name__}: {one_line(str(error))}"
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
    if stop_file.exists() or work.finished():  # the latter by an attempt whose worker died afterwards
        return None
    with open(log, "a", encoding="utf-8") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        try:
            work(stop_file.exists)
        except Exception as error:
            traceback.print_exc()
            return one_line(str(error)) or type(error).__name__
    return None


def _connected(address: str | None) -> Any:
    """Ray itself, connected to a cluster or, without an address, to a node begun here."""
    where = "local" if address is None else address
    closed = {LOOPBACK: "0"} if where == "local" else {}
    try:
        with environment(closed):
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
        with environment(closed):
            dashboard = False if closed else None
            ray.init(where, log_to_driver=False, logging_level=logging.ERROR, include_dashboard=dashboard)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise UserError(f"--address is {where}, where no Ray cluster answers: {error}") from error
    finally:
        for number, handler in handlers.items():  # of which Ray took one
            signal.signal(number, handler)
    return ray
