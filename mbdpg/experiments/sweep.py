"""`mbdpg sweep`: which settings learn best, searched by Optuna; every trial is an ordinary run."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain, starmap
from pathlib import Path
from typing import Any, Literal, final

import matplotlib
import numpy as np

matplotlib.use("Agg")  # no display is ever needed
from matplotlib import pyplot as plt

from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.launch import Engine, launch
from mbdpg.experiments.search import Search
from mbdpg.experiments.work import Training
from mbdpg.interfaces import UserError, as_flag, require
from mbdpg.reports.record import Curve, learning_curve, mean_curve
from mbdpg.storage.files import DamagedFileError, parse_object, read_checked, replace_durably, replace_table
from mbdpg.storage.run_folder import only_writer
from mbdpg.training.loop import Update

JOURNAL, NAME = "journal.log", "sweep"

LAST = 3
"""Evaluations whose mean is a trial's score: a single one is noisy."""

State = Literal["running", "complete", "pruned", "failed"]


@final
@dataclass(frozen=True)
class Trial:
    """One choice of settings, trained for all seeds; its note says how it ended."""

    number: int
    """Of the piece of work; Optuna's own may differ, since trials begin in any order."""
    config: RunConfig
    """Of which the searched settings are replaced."""
    searches: tuple[Search, ...]
    seeds: tuple[int, ...]
    prune: bool
    """Whether it is given up when its best so far is below the median of completed trials at the same step."""
    out: Path
    """Folder of the sweep."""

    @property
    def name(self) -> str:
        """Its number."""
        return f"trial {self.number}"

    @property
    def folder(self) -> Path:
        """Of its note and run folders."""
        return self.out / f"trial-{self.number:03d}"

    def note(self) -> dict[str, Any]:
        """What is known of it: Optuna's number, settings, and how it ended; empty before it began."""
        try:
            return parse_object(read_checked(self.folder / "trial.json", limit=1 << 20), "trial.json")
        except DamagedFileError:
            return {}

    def finished(self) -> bool:
        """Whether it has ended, in whatever way."""
        return self.note().get("state") in ("complete", "pruned", "failed")

    def __call__(self, should_stop: Callable[[], bool]) -> None:
        """Begin, or go on with the same settings where it was."""
        # The first evaluation with anything learned says little yet.
        study = opened(self.out, self.number, self.config.agent.random_steps + self.config.schedule.evaluate_every)
        trial = self._begun(study)
        values = {search.name: search.suggest(trial, self.config.agent) for search in self.searches}
        if study.trials[trial.number].state.is_finished():  # told, but its process died before it wrote the note
            ended = study.trials[trial.number].state.name
            state: State = "complete" if ended == "COMPLETE" else "pruned" if ended == "PRUNED" else "failed"
            return self._write(trial.number, values, state)
        self._write(trial.number, values, "running")
        try:
            agent = dataclasses.replace(self.config.agent, **values)
        except UserError as error:  # settings that exclude each other are no reason to end the sweep
            print(f"mbdpg: {error}")
            study.tell(trial, state=_optuna().trial.TrialState.FAIL)
            return self._write(trial.number, values, "failed")
        training = Training(dataclasses.replace(self.config, agent=agent), self.seeds, self.folder)
        reported = set(study.trials[trial.number].intermediate_values)
        bad = False

        def watch(update: Update) -> None:
            nonlocal bad
            for step, value in returns(training).items() if update.evaluation else ():
                if step > 0 and step not in reported:
                    trial.report(value, step)
                    reported.add(step)
                    bad = bad or (self.prune and trial.should_prune())

        training(lambda: bad or should_stop(), watch)
        if training.finished():
            reached = score(training)
            study.tell(trial, reached)  # which takes NaN for a failure
            self._write(trial.number, values, "failed" if math.isnan(reached) else "complete")
        elif bad:
            study.tell(trial, state=_optuna().trial.TrialState.PRUNED)
            self._write(trial.number, values, "pruned")

    def _begun(self, study: Any) -> Any:
        """A new trial, or the one that a process began which died; the journal knows whose it is."""
        for known in study.trials:
            if known.user_attrs.get("piece") == self.number:
                return _optuna().trial.Trial(study, known._trial_id)
        trial = study.ask()
        trial.set_user_attr("piece", self.number)
        return trial

    def _write(self, number: int, values: dict[str, Any], state: State) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        note = {"trial": number, "state": state, "settings": values}
        replace_durably(self.folder / "trial.json", json.dumps(note, indent=2).encode())


def sweep(
    config: RunConfig,
    searches: Sequence[Search],
    *,
    trials: int,
    seeds: Sequence[int],
    prune: bool,
    out: Path,
    engine: Engine,
    say: Callable[[str], None],
    should_stop: Callable[[], bool] = lambda: False,
) -> None:
    """Train what is missing of so many trials, then write what they say: sweep.csv, history.png and importance.png.

    Raises:
        UserError: the folder is another sweep's, Optuna is not installed, or no trial was completed.
    """
    _optuna()
    searched = [dataclasses.asdict(search) for search in searches]
    plan = json.dumps({"run": config.to_json(), "search": searched, "seeds": list(seeds)}, indent=2)
    kept = out / "sweep.json"
    same = not kept.exists() or kept.read_text(encoding="utf-8", errors="replace") == plan
    differs = f"{out} is of another sweep, or its {kept.name} is damaged; go on with its own flags"
    require(same, f"{differs}, or choose another --out")
    lost = not (out / JOURNAL).exists() and any(out.glob("trial-*"))
    require(not lost, f"{out} has trials but no {JOURNAL}; put it back, or choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    works = [Trial(number, config, tuple(searches), tuple(seeds), prune, out) for number in range(trials)]
    with only_writer(out):
        if not kept.exists():
            replace_durably(kept, plan.encode())
        _drop_torn_line(out / JOURNAL)
        failures = launch(works, engine, logs=out / "logs", say=say, should_stop=should_stop)
        if not should_stop():
            _conclude(works, out, say)
    require(not failures, f"{len(failures)} of {trials} trials failed, see {out / 'logs'}")


def _drop_torn_line(journal: Path) -> None:
    """Cut what a lost machine left of its last line: Optuna would append to it, and never read the journal again."""
    if journal.exists():
        with open(journal, "r+b") as file:
            file.truncate(file.read().rfind(b"\n") + 1)


def returns(training: Training) -> Curve:
    """Mean evaluation return over seeds at every step at which all of them were evaluated."""
    return mean_curve([learning_curve(run) if (run / "metrics.jsonl").is_file() else {} for run in training.runs()])


def score(training: Training) -> float:
    """Mean over seeds and the last evaluations with anything done before: what is maximized; NaN if all failed."""
    last = [value for step, value in returns(training).items() if step > 0][-LAST:]
    return float(np.mean(last)) if last else math.nan


def opened(out: Path, seed: int = 0, warm_up: int = 0) -> Any:
    """The study in a folder, kept in a journal that many processes may write to, as SQLite must not be."""
    optuna = _optuna()
    journal = optuna.storages.journal.JournalFileBackend(str(out / JOURNAL))
    return optuna.create_study(
        storage=optuna.storages.JournalStorage(journal),
        study_name=NAME,
        direction="maximize",
        load_if_exists=True,
        # Trials that run at the same time shall not try the same.
        sampler=optuna.samplers.TPESampler(constant_liar=True, seed=seed),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=4, n_warmup_steps=warm_up),
    )


def _conclude(works: Sequence[Trial], out: Path, say: Callable[[str], None]) -> None:
    optuna, study = _optuna(), opened(out)
    done = [trial for trial in study.trials if trial.state == optuna.trial.TrialState.COMPLETE]
    notes = [work.note() for work in works]
    values = {trial.number: trial.value for trial in done}
    scored = [note for note in notes if note.get("trial") in values]
    require(bool(scored), f"no trial was completed, see {out / 'logs'}")
    names = [search.name for search in works[0].searches]
    rows: list[Sequence[Any]] = [("trial", "state", "score", *names)]
    for number, note in enumerate(notes):
        settings, score_ = note.get("settings", {}), values.get(note.get("trial"), "")
        rows.append((number, note.get("state", "missing"), score_, *(settings.get(name, "") for name in names)))
    replace_table(out / "sweep.csv", rows)
    completed = sum(note.get("state") == "complete" for note in notes)
    say(f"{completed} of {len(works)} trials completed; all of them in {out / 'sweep.csv'}")
    best = max(scored, key=lambda note: values[note["trial"]])
    flags = chain.from_iterable(starmap(as_flag, best["settings"].items()))
    say(f"best, {values[best['trial']]:,.1f}: {' '.join(flags)}")
    _draw(study, done, out, say)


def _draw(study: Any, done: Sequence[Any], out: Path, say: Callable[[str], None]) -> None:
    plots: dict[str, Callable[[Any], Any]] = {"history": lambda draw: draw.plot_optimization_history(study)}
    if len({trial.value for trial in done}) > 1 and len(study.best_params) > 1:
        # Optuna's default evaluator needs scikit-learn.
        evaluator = _optuna().importance.PedAnovaImportanceEvaluator()
        plots["importance"] = lambda draw: draw.plot_param_importances(study, evaluator=evaluator)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are called experimental
        for name, plot in plots.items():
            axes = plot(_optuna().visualization.matplotlib)
            picture = io.BytesIO()
            axes.figure.savefig(picture, format="png", dpi=110, bbox_inches="tight")
            plt.close(axes.figure)
            replace_durably(out / f"{name}.png", picture.getvalue())
            say(f"{name} in {out / f'{name}.png'}")


def _optuna() -> Any:
    try:
        import optuna
    except ImportError as error:
        raise UserError("mbdpg sweep needs Optuna, which is not installed: pip install 'mbdpg[sweep]'") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
