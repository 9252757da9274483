"""Pieces of work that are runs: a configuration's training, and an expert's demonstrations."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import final

from mbdpg.experiments import expert
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.run import OnUpdate, resume, train
from mbdpg.interfaces import require
from mbdpg.storage.run_folder import RunFolder


@final
@dataclass(frozen=True)
class Training:
    """Runs of one configuration, in one process."""

    config: RunConfig
    seeds: tuple[int, ...]
    out: Path
    """Folder of the run folders."""

    @property
    def name(self) -> str:
        """Task, label and seeds."""
        return f"{self.out.parent.name} {self.out.name} seed {', '.join(map(str, self.seeds))}"

    def finished(self) -> bool:
        """Whether every seed has all its steps, with these settings."""
        return all(_steps_done(run) >= self.config.schedule.steps and _is_of(run, self.config) for run in self.runs())

    def __call__(self, should_stop: Callable[[], bool], on_update: OnUpdate = lambda update: None) -> None:
        """Begin, or go on where it was.

        Raises:
            UserError: a run folder has other settings.
        """
        keep_compilations()
        for run in self.runs():
            if run.exists() and _steps_done(run) < 0:
                shutil.rmtree(run)  # its process died before there was anything to go on from
            if run.exists():
                same = _is_of(run, self.config)
                require(same, f"{run} has other settings than this study's; move it away, or choose another --out")
                if _steps_done(run) < self.config.schedule.steps:
                    resume(run, steps=self.config.schedule.steps, watch=lambda *_: on_update, should_stop=should_stop)
        fresh = [seed for seed, run in zip(self.seeds, self.runs(), strict=True) if not run.exists()]
        if fresh and not should_stop():
            train(self.config, seeds=fresh, out=self.out, on_update=on_update, should_stop=should_stop)

    def begun(self) -> list[Path]:
        """Run folders with these settings that have something to show."""
        return [run for run in self.runs() if _steps_done(run) > 0 and _is_of(run, self.config)]

    def runs(self) -> list[Path]:
        """All run folders, begun or not."""
        return [self.out / f"seed-{seed}" for seed in self.seeds]


@final
@dataclass(frozen=True)
class Demonstrating:
    """An expert's training, and its successful episodes in a file."""

    expert: RunConfig
    success_return: float | None
    """None for what the task is known to need."""
    out: Path
    """Folder of the task."""

    @property
    def name(self) -> str:
        """Of the task's expert."""
        return f"{self.out.name} expert"

    @property
    def file(self) -> Path:
        """The demonstrations."""
        return self.out / "demonstrations.safetensors"

    def finished(self) -> bool:
        """Whether they are recorded."""
        return self.file.exists()

    def __call__(self, should_stop: Callable[[], bool]) -> None:
        """Train, then record."""
        training, config = Training(self.expert, (0,), self.out / "expert"), self.expert
        training(should_stop)
        if should_stop():
            return
        success = expert.success_in(config.env, config.env_options, self.success_return)
        found = expert.record_from(
            training.out / "seed-0", config.env, config.env_options, episodes=10, success_return=success, seed=0
        )
        found.save(self.file)


def _steps_done(run: Path) -> int:
    """Environment steps of a run's newest checkpoint, -1 without one."""
    return max((int(path.name) for path in (run / "checkpoints").glob("[0-9]*") if path.name.isdigit()), default=-1)


def _is_of(run: Path, config: RunConfig) -> bool:
    """Whether a run folder is of this configuration; only its length may differ."""
    found = RunConfig.from_json(RunFolder.open(run).config)
    return (
        dataclasses.replace(config, schedule=dataclasses.replace(config.schedule, steps=found.schedule.steps)) == found
    )
