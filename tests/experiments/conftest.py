"""What tests of many processes share."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread

import pytest


@pytest.fixture
def kill_in_the_middle() -> Callable[[Path, int], list[int]]:
    """Kills, in a thread, the process that holds a run's lock once the run has a checkpoint of so many steps.

    Gives the list that will hold that process's number.
    """

    def holders(lock: Path) -> list[int]:
        found = []
        for process in Path("/proc").iterdir():
            if process.name.isdigit() and process.name != str(os.getpid()):
                try:
                    held = {os.readlink(file) for file in (process / "fd").iterdir()}
                except OSError:  # it ended meanwhile
                    continue
                found += [int(process.name)] if str(lock.resolve()) in held else []
        return found

    def begin(run: Path, steps: int) -> list[int]:
        killed: list[int] = []

        def watch() -> None:
            # Or of more: older ones are soon removed.
            while not any(int(saved.name) >= steps for saved in (run / "checkpoints").glob("[0-9]" * 9)):
                time.sleep(0.02)
            for process in holders(run / "lock"):
                os.kill(process, signal.SIGKILL)
                killed.append(process)

        Thread(target=watch, daemon=True).start()
        return killed

    return begin
