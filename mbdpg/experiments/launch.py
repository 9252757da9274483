"""Many pieces of work at once; where and how is an engine's: this machine (pool.py) or a Ray cluster (cluster.py)."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

ATTEMPTS = 3
"""Times that a piece of work is begun whose process dies."""

POLL_SECONDS = 0.5
PLATFORM = "JAX_PLATFORMS"


@runtime_checkable
class Work(Protocol):
    """One piece, pickled to where it is done. Called again after its process died, it goes on from what is on disk."""

    @property
    def name(self) -> str:
        """Unique; also that of its log."""

    def finished(self) -> bool: ...

    def __call__(self, should_stop: Callable[[], bool]) -> None: ...


@runtime_checkable
class Engine(Protocol):
    """A place where pieces of work are done."""

    @property
    def seeds_together(self) -> bool:
        """Whether the seeds of a configuration are better one piece of work than one each."""

    @property
    def flags(self) -> Sequence[str]:
        """What chooses it on the command line, wherever it lies."""

    def run(
        self, works: Sequence[Work], logs: Path, say: Callable[[str], None], should_stop: Callable[[], bool]
    ) -> dict[str, str]:
        """See `launch`; none is finished, and the folder of logs is there."""


def launch(
    works: Sequence[Work],
    engine: Engine,
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
    return engine.run(due, logs, say, should_stop) if due else {}


def log_of(work: Work, logs: Path) -> Path:
    """The file that gets what a piece of work prints."""
    return logs / f"{re.sub(r'[^A-Za-z0-9.=-]+', '-', work.name)}.log"


@contextlib.contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Environment variables for processes started meanwhile."""
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)
