"""Ctrl-C and SIGTERM: save, say how to go on, and exit as a process does that a signal ended."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


class Stop:
    """Whether a signal asked the run to stop. Use it in a `with` block; a second signal ends the process at once."""

    def __init__(self) -> None:
        self.signal = 0
        """Number of the signal received, 0 for none."""

    def __call__(self) -> bool:
        return self.signal != 0

    def __enter__(self) -> Stop:
        self._before = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *reason: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def exit_if_asked(self, hint: str) -> None:
        """After the run has saved: leave with the hint and status 128 + signal, if there was one."""
        if self.signal:
            print(f"mbdpg: saved; go on with: {hint}", file=sys.stderr)
            sys.exit(128 + self.signal)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signal:
            os._exit(128 + number)
        self.signal = number
        # Not print: a handler may come in the middle of one.
        os.write(2, b"mbdpg: saving, then stopping; once more to stop at once, at the last checkpoint\n")
