"""What a person sees while a run goes on: one moving line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

PLAIN_SECONDS = 30.0
"""Between two plain lines, so that a log file stays readable."""

UNTIMED_SECONDS = 2.0
"""So early, a speed says nothing of those to come."""


class RunDisplay:
    """Shows steps, returns, speed and time left. Use it in a `with` block and call it after every cycle."""

    def __init__(self, steps: int, *, done: int = 0):
        """Expect `steps` environment steps in all, of which `done` lie behind."""
        self._steps, self._first, self._done = steps, done, done
        self._began = time.monotonic()
        self._shown = self._began - PLAIN_SECONDS
        self._evaluation = "-"
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            columns = (BarColumn(bar_width=20), TextColumn("{task.description}"))
            self._bar = Progress(*columns, console=Console(stderr=True), transient=False)
            self._task = self._bar.add_task("starting (the first updates are compiled, about a minute)", total=steps)

    def __enter__(self) -> RunDisplay:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *reason: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, update: Any) -> None:
        """Show a `mbdpg.training.loop.Update`."""
        self._done = update.env_steps
        evaluated = update.evaluation is not None
        if evaluated:
            returns = [value for evaluation in update.evaluation for value in evaluation.returns]
            self._evaluation = f"{np.mean(returns):.1f}" if returns else "-"
        text = self._text(update.train_returns)
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, description=text)
        elif evaluated or time.monotonic() - self._shown >= PLAIN_SECONDS or self._done >= self._steps:
            self._shown = time.monotonic()
            print(text, file=sys.stderr, flush=True)

    def _text(self, train_returns: list[float]) -> str:
        seconds = time.monotonic() - self._began
        speed = (self._done - self._first) / seconds if seconds > UNTIMED_SECONDS else 0.0
        known = [value for value in train_returns if np.isfinite(value)]
        episode = f"{np.mean(known):.1f}" if known else "-"
        left = _duration((self._steps - self._done) / speed) if speed > 0 else "-"
        return (
            f"step {self._done:,}/{self._steps:,}  episode return {episode}  evaluation {self._evaluation}  "
            f"{speed:.1f} steps/s  {left} left"
        )


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}h{minutes:02d}m" if hours else f"{minutes}m{rest:02d}s"
