"""Pieces of work that are runs: a configuration's training, and an expert's demonstrations."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from mbdpg.experiments import expert
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.origin import origin
from mbdpg.experiments.resuming import resume
from mbdpg.experiments.run import OnUpdate, train
from mbdpg.interfaces import UserError, require
from mbdpg.reports.record import setting
from mbdpg.storage.files import DamagedFileError, parse_object, read_checked, replace_durably
from mbdpg.storage.metrics import read_metrics
from mbdpg.storage.run_folder import RunFolder, discard_unbegun

ORIGIN = "origin"
"""In a note, what does not count as a setting: another commit may go on with what one began."""


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
        """Whether every seed has all its steps and its last evaluation, with these settings."""
        return self.done() == self.runs()

    def __call__(self, should_stop: Callable[[], bool], on_update: OnUpdate = lambda update: None) -> None:
        """Begin, or go on where it was.

        Raises:
            UserError: a run folder has other settings, or is none.
        """
        keep_compilations()
        steps, begun = self.config.schedule.steps, []
        for run in self.runs():
            if run.exists() and not any((run / "checkpoints").glob("[0-9]*")):
                discard_unbegun(run)
            if run.exists():
                same = _is_of(run, self.config)
                require(same, f"{run} has other settings than this one's; move it away, or choose another --out")
                if steps_evaluated(run) < steps:
                    begun.append(run)
        allowed = self.config.env_options.allow_import
        resume(begun, steps=steps, allow_import=allowed, watch=lambda *_: on_update, should_stop=should_stop)
        fresh = [seed for seed, run in zip(self.seeds, self.runs(), strict=True) if not run.exists()]
        if fresh and not should_stop():
            train(self.config, seeds=fresh, out=self.out, on_update=on_update, should_stop=should_stop)

    def done(self) -> list[Path]:
        """The run folders that are finished."""
        return [run for run in self.runs() if self._is_done(run)]

    def runs(self) -> list[Path]:
        """All run folders, begun or not."""
        return [self.out / f"seed-{seed}" for seed in self.seeds]

    def _is_done(self, run: Path) -> bool:
        """Whether a run with these settings was evaluated at its last step; not a damaged one."""
        try:
            return steps_evaluated(run) >= self.config.schedule.steps and _is_of(run, self.config)
        except UserError:  # going on with it says what is wrong
            return False


@final
@dataclass(frozen=True)
class Demonstrating:
    """An expert's training, and its successful episodes in a file."""

    expert: RunConfig
    success_return: float
    """Least return of a success."""
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
        """Whether they are recorded, by this expert."""
        return is_made_as(self.file, self._settings())

    def __call__(self, should_stop: Callable[[], bool]) -> None:
        """Train, then record.

        Raises:
            UserError: there are demonstrations made otherwise, or the expert has no success.
        """
        refuse_made_otherwise(self.file, self._settings())
        training, config = Training(self.expert, (0,), self.out / "expert"), self.expert
        training(should_stop)
        if should_stop():
            return
        run, success = training.runs()[0], self.success_return
        found = expert.record_from(run, config.env, config.env_options, episodes=10, success_return=success, seed=0)
        say_made_as(self.file, self._settings())
        found.save(self.file)

    def _settings(self) -> dict[str, Any]:
        return {"expert": self.expert.to_json(), "success_return": self.success_return}


def is_made_as(file: Path, settings: Mapping[str, Any]) -> bool:
    """Whether a file is there and was made with these settings, as the note beside it says."""
    noted = {name: value for name, value in _noted(file).items() if name != ORIGIN}
    return file.exists() and _as_text(noted) == _as_text(settings)


def refuse_made_otherwise(file: Path, settings: Mapping[str, Any]) -> None:
    """Leave what was made with other settings, or nobody knows how, as it is.

    Raises:
        UserError: a file is there and was.
    """
    fits = not file.exists() or is_made_as(file, settings)
    require(fits, f"{file} was made with other settings; move it away, or choose another --out")


def say_made_as(file: Path, settings: Mapping[str, Any]) -> None:
    """Write the note that `is_made_as` and `origin_of` read, before the file itself."""
    file.parent.mkdir(parents=True, exist_ok=True)
    replace_durably(_note(file), _as_text({**settings, ORIGIN: origin()}).encode())


def origin_of(file: Path) -> dict[str, Any]:
    """The commit and the machine that made a file, as the note beside it says; empty where it does not."""
    return setting(_noted(file), ORIGIN)


def steps_evaluated(run: Path) -> int:
    """Environment steps at which a run was last evaluated, -1 if it was not.

    Not those of its last checkpoint: a run that is stopped before its last evaluation has one of the same step.
    """
    if not (run / "metrics.jsonl").is_file():
        return -1
    rows = read_metrics(run, "eval")  # and timings, which another process of the run may have written alone
    faults = rows.get("eval/faults", [None] * len(rows["env_steps"]))
    return max((step for step, known in zip(rows["env_steps"], faults, strict=True) if known is not None), default=-1)


def _note(file: Path) -> Path:
    return file.with_name(f"{file.name}.settings.json")


def _noted(file: Path) -> dict[str, Any]:
    try:
        return parse_object(read_checked(_note(file), limit=1 << 20), _note(file))
    except DamagedFileError:
        return {}


def _as_text(settings: Mapping[str, Any]) -> str:
    return json.dumps(settings, indent=2, sort_keys=True)


def _is_of(run: Path, config: RunConfig) -> bool:
    """Whether a run folder is of this configuration; its length may differ, and the place of its demonstrations."""
    found = RunConfig.of(RunFolder.open(run))
    if config.demonstrations and found.demonstrations:
        found = dataclasses.replace(found, demonstrations=config.demonstrations)
    return (
        dataclasses.replace(config, schedule=dataclasses.replace(config.schedule, steps=found.schedule.steps)) == found
    )
