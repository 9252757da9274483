"""`mbdpg reproduce`: a study's missing runs, then its figure and table, drawn from what lies on disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mbdpg.experiments import expert
from mbdpg.experiments.cluster import Ray
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.launch import Engine, Work, launch
from mbdpg.experiments.model_study import ModelFit, is_whole
from mbdpg.experiments.studies import SCALES, Cell, Model, Scale, ScaleName, Study, StudyName, study
from mbdpg.experiments.work import Demonstrating, Training, origin_of
from mbdpg.interfaces import require
from mbdpg.reports.figures import write_figure
from mbdpg.reports.panels import Curves, Errors
from mbdpg.reports.record import Record
from mbdpg.storage.run_folder import only_writer


def reproduce(
    name: StudyName,
    scale_name: ScaleName,
    out: Path,
    engine: Engine,
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
        UserError: something could not be done, for example because a run there has other settings; the figure is then
            drawn without it.
    """
    scale = SCALES[scale_name]
    scale = dataclasses.replace(scale, seeds=tuple(seeds)) if seeds else scale
    chosen = study(name, scale_name)
    # Seeds that share a GPU are one program; on cores each has one of its own.
    together = isinstance(engine, Ray) and engine.gpus
    groups = [scale.seeds] if together else [(seed,) for seed in scale.seeds]
    first, then = _works(chosen, scale, groups, out)
    heading = [f"`{_command(name, scale_name, seeds, engine)}`", f"The paper says: {chosen.claim}"]
    say(f"{name}: {heading[-1]}")
    failures: dict[str, str] = {}
    with only_writer(out):
        for works in (first, then):
            due = sum(not work.finished() for work in works)
            say(f"{name}: {due} of {len(works)} to do" if works else f"{name}: nothing to prepare")
            failures |= launch(works, engine, logs=out / "logs", say=say, should_stop=should_stop)
            if should_stop():
                return
        if failures:
            heading.append(f"Not here, for they failed: {'; '.join(sorted(failures))}.")
        _draw(chosen, scale, out, heading, say)
    logs, count = out / "logs", len(first) + len(then)
    require(not failures, f"{len(failures)} of {count} failed (see {logs}); the figure lacks them")


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
            teacher = _teacher(RunConfig(model.env), scale.recorded_steps, scale)
            recorded = Training(teacher, (0,), out / model.env / "recorded")
            add(first, recorded)
            for seed in scale.seeds:
                file = _errors_file(model, seed, out)
                data = recorded.out / "seed-0"
                given = (model.agent, scale.model_updates, data, scale.recorded_steps, seed, file)
                fitting = (*given, model.aggregation, model.members)
                add(then, ModelFit(f"{model.env} {model.label}", *fitting))
    return list(first.values()), list(then.values())


def _training(cell: Cell, seeds: tuple[int, ...], scale: Scale, out: Path) -> Training:
    demonstrations = str(_demonstrating(cell, scale, out).file) if cell.demonstrated else None
    return Training(dataclasses.replace(cell.config, demonstrations=demonstrations), seeds, out / cell.folder)


def _demonstrating(cell: Cell, scale: Scale, out: Path) -> Demonstrating:
    teacher = _teacher(cell.config, scale.expert_steps, scale)
    success = expert.success_in(teacher.env, teacher.env_options, None)
    return Demonstrating(teacher, scale.success_share * success, out / cell.config.env)


def _teacher(like: RunConfig, steps: int, scale: Scale) -> RunConfig:
    """TD3 on the same task."""
    config = expert.config_of(like.env, steps, like.env_options)
    tiny = {name: value for name, value in scale.tiny.items() if hasattr(config.agent, name)}
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, **tiny))


def _errors_file(model: Model, seed: int, out: Path) -> Path:
    return out / model.env / "models" / model.label.replace(" ", "-") / f"seed-{seed}.csv"


def _command(name: StudyName, scale_name: ScaleName, seeds: Sequence[int], engine: Engine) -> str:
    """What makes the same from nothing, wherever it lies."""
    words = ["mbdpg reproduce", name, "--scale", scale_name, *(["--seeds", *map(str, seeds)] if seeds else [])]
    if isinstance(engine, Ray):
        words += ["--engine ray", *(["--gpus"] * engine.gpus)]
    return " ".join(words)


def _draw(chosen: Study, scale: Scale, out: Path, heading: Sequence[str], say: Callable[[str], None]) -> None:
    """The study's figure, its numbers as CSV and its tables, from whatever is finished."""
    panels: list[Curves | Errors] = []
    for panel in chosen.panels:
        if panel.models:
            files = {}
            for model in panel.models:
                whole = [file for seed in scale.seeds if is_whole(file := _errors_file(model, seed, out))]
                files[model.label] = {file: origin_of(file) for file in whole}
            panels.append(Errors(panel.title, {label: found for label, found in files.items() if found}))
        else:
            done = {cell.label: _training(cell, scale.seeds, scale, out).done() for cell in panel.cells}
            runs = {label: [Record.read(run, root=out) for run in found] for label, found in done.items()}
            shown = {label: found for label, found in runs.items() if found}
            panels.append(Curves(panel.title, shown, panel.published_hours))
    for line in write_figure(chosen.name, panels, out, heading=heading, as_hours=chosen.as_hours):
        say(line)
