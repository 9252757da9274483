"""`mbdpg reproduce`: a study's missing runs, then its figure and table, drawn from what lies on disk."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from mbdpg.experiments import expert
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.launch import Local, Ray, Work, launch
from mbdpg.experiments.model_study import ModelFit
from mbdpg.experiments.run import resume, train
from mbdpg.experiments.studies import RECORDED, SCALES, Cell, Model, Scale, ScaleName, Study, StudyName, study
from mbdpg.interfaces import UserError, require
from mbdpg.reports.figures import Curves, Errors, write_figure
from mbdpg.storage.run_folder import RunFolder


def reproduce(
    name: StudyName,
    scale_name: ScaleName,
    out: Path,
    engine: Local | Ray,
    *,
    seeds: Sequence[int] = (),
    say: Callable[[str], None],
    should_stop: Callable[[], bool] = lambda: False,
) -> None:
    """Do what is missing of a study, skip what is finished, go on with what was begun; draw it.

    Args:
        name: figure or table of the paper.
        scale_name: how much of it.
        out: folder that studies of one scale share, with their runs.
        engine: where it is done.
        seeds: instead of the scale's.
        say: called with a line of text now and then.
        should_stop: asked often.

    Raises:
        UserError: a run that is there already has other settings, or nothing of the study could be done.
    """
    scale = SCALES[scale_name]
    scale = dataclasses.replace(scale, seeds=tuple(seeds)) if seeds else scale
    chosen = study(name, scale_name)
    # Seeds that share a GPU are one program; on cores each has one of its own.
    together = isinstance(engine, Ray) and engine.gpus
    groups = [scale.seeds] if together else [(seed,) for seed in scale.seeds]
    first, then = _works(chosen, scale, groups, out)
    failures: dict[str, str] = {}
    for works in (first, then):
        due = [work for work in works if not work.finished()]
        say(f"{name}: {len(due)} of {len(works)} to do" if works else f"{name}: nothing to prepare")
        failures |= launch(due, engine, logs=out / "logs", say=say, should_stop=should_stop)
        if should_stop():
            return
    _draw(chosen, scale, out, say)
    if failures:
        raise UserError(
            f"{len(failures)} of {len(first) + len(then)} failed (see {out / 'logs'}); the figure lacks them"
        )


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
        return all(_steps_done(run) >= self.config.schedule.steps and _is_of(run, self.config) for run in self._runs())

    def __call__(self, should_stop: Callable[[], bool]) -> None:
        """Begin, or go on where it was.

        Raises:
            UserError: a run folder has other settings.
        """
        keep_compilations()
        for run in self._runs():
            if run.exists() and _steps_done(run) < 0:
                shutil.rmtree(run)  # its process died before there was anything to go on from
            if run.exists():
                same = _is_of(run, self.config)
                require(same, f"{run} has other settings than this study's; move it away, or choose another --out")
                if _steps_done(run) < self.config.schedule.steps:
                    resume(run, steps=self.config.schedule.steps, should_stop=should_stop)
        fresh = [seed for seed, run in zip(self.seeds, self._runs(), strict=True) if not run.exists()]
        if fresh and not should_stop():
            train(self.config, seeds=fresh, out=self.out, should_stop=should_stop)

    def begun(self) -> list[Path]:
        """Run folders with these settings that have something to show."""
        return [run for run in self._runs() if _steps_done(run) > 0 and _is_of(run, self.config)]

    def _runs(self) -> list[Path]:
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


def _works(chosen: Study, scale: Scale, groups: Sequence[tuple[int, ...]], out: Path) -> tuple[list[Work], list[Work]]:
    """What has to be done first, and what builds on it; pieces that several panels share, once."""
    first: dict[str, Work] = {}
    then: dict[str, Work] = {}

    def add(works: dict[str, Work], work: Any) -> None:
        works[work.name] = work

    for panel in chosen.panels:
        for cell in panel.cells:
            if cell.demonstrated:
                add(first, _demonstrating(cell, scale, out))
            for seeds in groups:
                add(then, _training(cell, seeds, scale, out))
        for model in panel.models:
            recorded = Training(
                _teacher(RunConfig(RECORDED), scale.recorded_steps, scale), (0,), out / RECORDED / "recorded"
            )
            add(first, recorded)
            for seed in scale.seeds:
                file = _errors_file(model, seed, out)
                data = recorded.out / "seed-0"
                fitting = (model.agent, scale.model_updates, data, seed, file, model.aggregation, model.members)
                add(then, ModelFit(model.label, *fitting))
    return list(first.values()), list(then.values())


def _training(cell: Cell, seeds: tuple[int, ...], scale: Scale, out: Path) -> Training:
    demonstrations = str(_demonstrating(cell, scale, out).file) if cell.demonstrated else None
    return Training(dataclasses.replace(cell.config, demonstrations=demonstrations), seeds, out / cell.folder)


def _demonstrating(cell: Cell, scale: Scale, out: Path) -> Demonstrating:
    teacher = _teacher(cell.config, scale.expert_steps, scale)
    return Demonstrating(teacher, scale.success_return, out / cell.config.env)


def _teacher(like: RunConfig, steps: int, scale: Scale) -> RunConfig:
    """TD3 on the same task."""
    config = expert.config_of(like.env, steps, like.env_options)
    tiny = {name: value for name, value in scale.tiny.items() if hasattr(config.agent, name)}
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, **tiny))


def _errors_file(model: Model, seed: int, out: Path) -> Path:
    return out / "models" / model.label.replace(" ", "-") / f"seed-{seed}.csv"


def _steps_done(run: Path) -> int:
    """Environment steps of a run's newest checkpoint, -1 without one."""
    return max((int(path.name) for path in (run / "checkpoints").glob("[0-9]*") if path.name.isdigit()), default=-1)


def _is_of(run: Path, config: RunConfig) -> bool:
    """Whether a run folder is of this configuration; only its length may differ."""
    found = RunConfig.from_json(RunFolder.open(run).config)
    return (
        dataclasses.replace(config, schedule=dataclasses.replace(config.schedule, steps=found.schedule.steps)) == found
    )


def _draw(chosen: Study, scale: Scale, out: Path, say: Callable[[str], None]) -> None:
    """The study's figure, and its numbers as CSV, from whatever is there."""
    panels: list[Curves | Errors] = []
    for panel in chosen.panels:
        if panel.models:
            files = {
                model.label: [file for seed in scale.seeds if (file := _errors_file(model, seed, out)).exists()]
                for model in panel.models
            }
            panels.append(Errors(panel.title, {label: found for label, found in files.items() if found}))
        else:
            runs = {cell.label: _training(cell, scale.seeds, scale, out).begun() for cell in panel.cells}
            panels.append(Curves(panel.title, {label: found for label, found in runs.items() if found}))
    for line in write_figure(chosen.name, panels, out, as_hours=chosen.as_hours):
        say(line)
