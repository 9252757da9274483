"""`mbdpg reproduce`: a study's missing runs, then its figure and table, drawn from what lies on disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from mbdpg.experiments import expert
from mbdpg.experiments.config import EnvOptions, RunConfig
from mbdpg.experiments.launch import Engine, Work, launch
from mbdpg.experiments.model_study import ModelFit
from mbdpg.experiments.presets import PAPER_EPISODE_LIMIT
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
    heading = [f"`{_command(name, scale_name, seeds, engine)}`", f"The paper says: {chosen.claim}"]
    say(f"{name}: {heading[-1]}")
    groups = [scale.seeds] if engine.seeds_together else [(seed,) for seed in scale.seeds]
    pieces = _pieces(chosen, scale, groups, out)
    first = {piece.needs.name: piece.needs for piece in pieces if piece.needs}
    failures: dict[str, str] = {}

    def do(works: Sequence[Work]) -> None:
        say(f"{name}: {sum(not work.finished() for work in works)} of {len(works)} to do")
        failures.update(launch(works, engine, logs=out / "logs", say=say, should_stop=should_stop))

    with only_writer(out):
        if first:
            do([*first.values()])
        lacking = {
            p.work.name: p.needs.name for p in pieces if p.needs and p.needs.name in failures and not p.work.finished()
        }
        if not should_stop():
            do([*{p.work.name: p.work for p in pieces if p.work.name not in lacking}.values()])
        if should_stop():
            return
        for left, needed in lacking.items():
            failures[left] = f"left out, it needs {needed}"
            say(f"{left}: {failures[left]}")
        if failures:
            heading.append(f"Not finished, for it failed or was left out: {'; '.join(sorted(failures))}.")
        _draw(chosen, scale, out, heading, say)
    count = len(first.keys() | {piece.work.name for piece in pieces})
    wrong = f"{len(failures)} of {count} failed or were left out"
    require(not failures, f"{wrong} (see {out / 'logs'}); the figure lacks them")


class _Piece(NamedTuple):
    """A piece of work, and what has to be done before."""

    work: Work
    needs: Work | None = None


def _pieces(chosen: Study, scale: Scale, groups: Sequence[tuple[int, ...]], out: Path) -> list[_Piece]:
    """All that a study is made of; what several panels share is there several times."""
    found: list[_Piece] = []
    for panel in chosen.panels:
        for cell in panel.cells:
            shown = _demonstrating(cell, scale, out) if cell.demonstrated else None
            found += [_Piece(_training(cell, shown, seeds, out), shown) for seeds in groups]
        for model in panel.models:
            recorded = _recording(model, scale, out)
            found += [_Piece(_fitting(model, seed, scale, out), recorded) for seed in scale.seeds]
    return found


def _training(cell: Cell, shown: Demonstrating | None, seeds: tuple[int, ...], out: Path) -> Training:
    demonstrations = str(shown.file) if shown else None
    return Training(dataclasses.replace(cell.config, demonstrations=demonstrations), seeds, out / cell.folder)


def _demonstrating(cell: Cell, scale: Scale, out: Path) -> Demonstrating:
    teacher = _teacher(cell.config, scale.expert_steps, scale)
    success = expert.success_in(teacher.env, teacher.env_options, None)
    return Demonstrating(teacher, scale.success_share * success, out / cell.config.env)


def _recording(model: Model, scale: Scale, out: Path) -> Training:
    """The run whose steps a model learns from."""
    task = RunConfig(model.env, env_options=EnvOptions(max_episode_steps=PAPER_EPISODE_LIMIT))
    return Training(_teacher(task, scale.recorded_steps, scale), (0,), out / model.env / "recorded")


def _fitting(model: Model, seed: int, scale: Scale, out: Path) -> ModelFit:
    (data,) = _recording(model, scale, out).runs()
    return ModelFit(
        label=f"{model.env} {model.label}",
        agent=model.agent,
        updates=scale.model_updates,
        data=data,
        data_steps=scale.recorded_steps,
        seed=seed,
        out=out / model.env / "models" / model.label.replace(" ", "-") / f"seed-{seed}.csv",
        aggregation=model.aggregation,
        members=model.members,
    )


def _teacher(like: RunConfig, steps: int, scale: Scale) -> RunConfig:
    """TD3 on the same task."""
    config = expert.config_of(like.env, steps, like.env_options)
    return dataclasses.replace(config, agent=scale.shrunk(config.agent))


def _command(name: StudyName, scale_name: ScaleName, seeds: Sequence[int], engine: Engine) -> str:
    """What makes the same from nothing, wherever it lies."""
    chosen = ["--seeds", *map(str, seeds)] if seeds else []
    return " ".join(["mbdpg reproduce", name, "--scale", scale_name, *chosen, *engine.flags])


def _draw(chosen: Study, scale: Scale, out: Path, heading: Sequence[str], say: Callable[[str], None]) -> None:
    """The study's figure, its numbers as CSV and its tables, from whatever is finished."""
    panels: list[Curves | Errors] = []
    for panel in chosen.panels:
        if panel.models:
            files = {}
            for model in panel.models:
                fits = [_fitting(model, seed, scale, out) for seed in scale.seeds]
                files[model.label] = {fit.out: origin_of(fit.out) for fit in fits if fit.finished()}
            panels.append(Errors(panel.title, {label: found for label, found in files.items() if found}))
        else:
            shown_to = {c.label: _demonstrating(c, scale, out) if c.demonstrated else None for c in panel.cells}
            done = {c.label: _training(c, shown_to[c.label], scale.seeds, out).done() for c in panel.cells}
            runs = {label: [Record.read(run, root=out) for run in found] for label, found in done.items()}
            shown = {label: found for label, found in runs.items() if found}
            panels.append(Curves(panel.title, shown, panel.published_hours))
    for line in write_figure(chosen.name, panels, out, heading=heading, as_hours=chosen.as_hours):
        say(line)
