"""`mbdpg sweep`: which settings learn best, searched by Optuna; every trial is an ordinary run."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final, get_args, get_origin, get_type_hints

import numpy as np
from matplotlib import pyplot as plt

from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.launch import Local, Ray, launch
from mbdpg.experiments.work import Training
from mbdpg.interfaces import UserError, flag_of, require
from mbdpg.reports.record import learning_curve
from mbdpg.storage.files import DamagedFileError, parse_object, read_checked, replace_durably
from mbdpg.training.loop import Update

JOURNAL, NAME = "journal.log", "sweep"

LAST = 3
"""Evaluations whose mean is a trial's score: a single one is noisy."""

State = Literal["running", "complete", "pruned", "failed"]


@final
@dataclass(frozen=True)
class Search:
    """The values that one setting may take: a range of numbers, or some choices."""

    name: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    choices: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str, agent: Any) -> Search:
        """Read `horizon=1:20`, `actor-learning-rate=1e-5:1e-3:log` or `gradient=full,eq19`.

        Raises:
            UserError: it is none of these, or the agent has no such setting.
        """
        name, equals, values = text.partition("=")
        name = name.removeprefix("--").replace("-", "_")
        known = {field.name for field in dataclasses.fields(agent)}
        require(name in known, f"--search {text}: there is no {flag_of(name)}; expected a setting of the algorithm")
        low, colon, rest = values.partition(":")
        if not colon:
            choices = tuple(part for part in values.split(",") if part)
            require(bool(equals) and len(choices) > 1, f"--search {text}: expected {name}=LOW:HIGH or {name}=A,B,C")
            for choice in choices:
                _typed(choice, get_type_hints(type(agent))[name], text)
            return cls(name, choices=choices)
        kind = get_type_hints(type(agent))[name]
        if kind not in (int, float):
            names = ", ".join(map(str, get_args(kind))) or "true, false"
            raise UserError(f"--search {text}: expected some of {names}, with commas between")
        high, _, scale = rest.partition(":")
        require(scale in ("", "log"), f"--search {text}: expected :log or nothing after the range")
        try:
            found = cls(name, float(low), float(high), scale == "log")
        except ValueError as error:
            raise UserError(f"--search {text}: expected numbers, {name}=LOW:HIGH") from error
        ordered = math.isfinite(found.low) and math.isfinite(found.high) and found.low < found.high
        require(ordered, f"--search {text}: expected a lower number before a higher one")
        require(not found.log or found.low > 0, f"--search {text}: a logarithmic range begins above 0")
        return found

    def suggest(self, trial: Any, agent: Any) -> Any:
        """This trial's value, of the setting's own type."""
        kind = get_type_hints(type(agent))[self.name]
        if self.choices:
            return _typed(trial.suggest_categorical(self.name, list(self.choices)), kind, self.name)
        if kind is int:
            return trial.suggest_int(self.name, round(self.low), round(self.high), log=self.log)
        return trial.suggest_float(self.name, self.low, self.high, log=self.log)


def _typed(choice: str, kind: Any, text: str) -> Any:
    """A choice as the setting's type has it."""
    if get_origin(kind) is Literal:
        known = {str(value): value for value in get_args(kind)}
        expected = f"some of {', '.join(known)}, with commas between"
    elif kind is bool:
        known, expected = {"true": True, "false": False}, "true,false"
    else:
        try:
            return kind(choice)
        except ValueError as error:
            numbers = "whole numbers" if kind is int else "numbers"
            raise UserError(f"--search {text}: expected {numbers}, not {choice}") from error
    require(choice in known, f"--search {text}: expected {expected}")
    return known[choice]


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
    """Whether it is given up when it is worse than the median of the others at the same step."""
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
        study = opened(self.out, self.number)
        trial = self._begun(study)
        values = {search.name: search.suggest(trial, self.config.agent) for search in self.searches}
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
            study.tell(trial, score(training))
            self._write(trial.number, values, "complete")
        elif bad:
            study.tell(trial, state=_optuna().trial.TrialState.PRUNED)
            self._write(trial.number, values, "pruned")

    def _begun(self, study: Any) -> Any:
        """A new trial, or the one that a process began which died."""
        known = self.note().get("trial")
        if not isinstance(known, int) or known >= len(study.trials):
            return study.ask()
        return _optuna().trial.Trial(study, study.trials[known]._trial_id)

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
    engine: Local | Ray,
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
    same = not kept.exists() or kept.read_text(encoding="utf-8") == plan
    require(same, f"{out} is of another sweep; go on with its own flags, or choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    replace_durably(kept, plan.encode())
    works = [Trial(number, config, tuple(searches), tuple(seeds), prune, out) for number in range(trials)]
    failures = launch(works, engine, logs=out / "logs", say=say, should_stop=should_stop)
    if not should_stop():
        _conclude(works, out, say)
    require(not failures, f"{len(failures)} of {trials} trials failed, see {out / 'logs'}")


def returns(training: Training) -> dict[int, float]:
    """Mean evaluation return over seeds at every step at which all of them were evaluated."""
    curves = [learning_curve(run) if (run / "metrics.jsonl").is_file() else {} for run in training.runs()]
    shared = sorted(set.intersection(*map(set, curves)))
    return {step: float(np.mean([curve[step] for curve in curves])) for step in shared}


def score(training: Training) -> float:
    """Mean over seeds and the last evaluations: what is maximized."""
    return float(np.mean([*returns(training).values()][-LAST:]))


def opened(out: Path, seed: int = 0) -> Any:
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
        pruner=optuna.pruners.MedianPruner(n_startup_trials=4),
    )


def _conclude(works: Sequence[Trial], out: Path, say: Callable[[str], None]) -> None:
    optuna, study = _optuna(), opened(out)
    done = [trial for trial in study.trials if trial.state == optuna.trial.TrialState.COMPLETE]
    require(bool(done), f"no trial was completed, see {out / 'logs'}")
    notes = [work.note() for work in works]
    values = {trial.number: trial.value for trial in done}
    names = [search.name for search in works[0].searches]
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["trial", "state", "score", *names])
    for number, note in enumerate(notes):
        settings = note.get("settings", {})
        score_ = values.get(note.get("trial"), "")
        rows.writerow([number, note.get("state", "missing"), score_, *(settings.get(name, "") for name in names)])
    replace_durably(out / "sweep.csv", text.getvalue().encode())
    say(f"{len(done)} of {len(works)} trials completed; all of them in {out / 'sweep.csv'}")
    best = max((note for note in notes if note.get("trial") in values), key=lambda note: values[note["trial"]])
    flags = " ".join(f"{flag_of(name)} {value}" for name, value in best["settings"].items())
    say(f"best, {values[best['trial']]:,.1f}: {flags}")
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
