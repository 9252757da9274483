"""Run folders side by side: which belong together, what sets groups apart, and what each reached at the same step."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mbdpg.interfaces import require
from mbdpg.reports.record import Curve, Record, setting, shared_steps, text
from mbdpg.reports.statistics import Summary, probability_of_improvement, summarize

LOOKS_ON = {"steps", "evaluate_every", "evaluation_episodes", "log_every", "checkpoint_every"}
"""Settings that change nothing of what is learned at a step."""

NO_COMMON_STEP = "these runs have no evaluation at the same step, or none yet; train them further, or report fewer"


class Row(NamedTuple):
    """What a group of runs reached."""

    label: str
    steps: tuple[int, int]
    """Environment steps of the scores: the fewest and the most."""
    summary: Summary
    beaten: float | None
    """How often a run of the group with the highest mean is better than one of these; None for that group."""


class Comparison(NamedTuple):
    """Groups at one step."""

    rows: list[Row]
    """Of each group that has a run there."""
    notes: list[str]
    """What is missing in them, and why."""


def run_folders(paths: Sequence[Path]) -> list[Path]:
    """The run folders that these are, or that lie in them.

    Raises:
        UserError: one is neither.
    """
    found: list[Path] = []
    for path in paths:
        inside = [config.parent for config in sorted(path.glob("**/config.json"))] if path.is_dir() else []
        require(bool(inside), f"{path} is no run folder and has none in it")
        found += [folder for folder in inside if folder not in found]
    return found


def grouped(runs: Sequence[Record]) -> dict[str, dict[str, list[Record]]]:
    """Runs of the same settings: for each environment, those by a label that tells groups apart."""
    found: dict[str, dict[_Settings, list[Record]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        found[str(run.config.get("env"))][_settings(run)].append(run)
    return {env: _labelled(groups) for env, groups in found.items()}


_Settings = tuple[tuple[str, str], ...]
"""Names and values as text, as a label shows them, so that whatever tells groups apart can be seen in their labels."""


def _settings(run: Record) -> _Settings:
    """What the run learned with; a setting that is None is one that is absent."""
    flat = {"algorithm": run.config.get("algorithm"), "demonstrations": run.config.get("demonstrations")}
    for part in ("agent", "env_options", "schedule"):
        flat |= setting(run.config, part)
    return tuple((name, text(flat[name])) for name in sorted(flat.keys() - LOOKS_ON) if flat[name] is not None)


def _labelled(groups: Mapping[_Settings, list[Record]]) -> dict[str, list[Record]]:
    """Each group's algorithm, and those of its settings in which another group of that algorithm differs."""
    labels: dict[str, list[Record]] = defaultdict(list)
    for settings, runs in groups.items():
        own = dict(settings)
        algorithm = own.get("algorithm", text(None))
        peers = [peer for peer in map(dict, groups) if peer.get("algorithm") == own.get("algorithm")]
        differing = (name for name in own if any(peer.get(name) != own[name] for peer in peers))
        # Added to: a stranger's text may make two labels one, and no run is to be lost to that.
        labels[" ".join([algorithm, *(f"{name}={own[name]}" for name in differing)])] += runs
    return dict(labels)


def check_step(runs: Sequence[Record], at: int | None) -> None:
    """Look that something can be compared there.

    Raises:
        UserError: no run was evaluated at that step.
    """
    steps = sorted({step for run in runs for step in run.curve})
    require(at is None or at in steps, f"--at is {at}, expected a step at which a run was evaluated: {_some(steps)}")


def compare(groups: Mapping[str, Sequence[Record]], *, at: int | None = None) -> Comparison:
    """What each group reached at a step.

    Args:
        groups: of runs that have a curve, by label.
        at: environment steps at which they are compared, without those that have no evaluation there; by default the
            last at which all have one.
    """
    curves = {label: [run.curve for run in own] for label, own in groups.items()}
    every = {run.name: curve for label, own in groups.items() for run, curve in zip(own, curves[label], strict=True)}
    if at is None:
        shared = shared_steps(every.values())
        if not shared:
            return Comparison([], [NO_COMMON_STEP])
        step, notes = shared[-1], _held_back(every, shared[-1])
    else:
        step, notes = at, _without(every, at)
    notes += [note for label, own in groups.items() for note in _repeated(label, own)]
    points = {label: [(step, curve[step]) for curve in own if step in curve] for label, own in curves.items()}
    return Comparison(_rows({label: own for label, own in points.items() if own}), notes)


def _repeated(label: str, runs: Sequence[Record]) -> list[str]:
    """Which seeds a group has more than once: their runs are the same and no further evidence."""
    by_seed: dict[int, list[str]] = defaultdict(list)
    for run in runs:
        if isinstance(seed := run.config.get("seed"), int):
            by_seed[seed].append(run.name)
    several = {seed: names for seed, names in by_seed.items() if len(names) > 1}
    return [
        f"seed {seed} counts {len(names)} times in {label}, which makes intervals too narrow: {', '.join(names)}"
        for seed, names in several.items()
    ]


def _held_back(curves: Mapping[str, Curve], step: int) -> list[str]:
    """Which runs end at the step that all share, if that is less than half of what another has."""
    furthest = max(max(curve) for curve in curves.values())
    if furthest <= 2 * step:
        return []
    short = [name for name, curve in curves.items() if max(curve) == step]
    why = f"no more have {', '.join(short)}" if short else "evaluations are at different steps"
    return [f"compared at {step:,} of {furthest:,} steps: {why}; with --at STEPS runs that lack it are left out"]


def _without(curves: Mapping[str, Curve], step: int) -> list[str]:
    """Which runs have no evaluation at the step."""
    missing = [f"{name} (last at {max(curve):,})" for name, curve in curves.items() if step not in curve]
    return [f"not evaluated at {step:,} steps, so not compared: {', '.join(missing)}"] if missing else []


def compare_last(groups: Mapping[str, Sequence[Record]]) -> list[Row]:
    """What each group reached at the last evaluation of each of its runs, which all have one."""
    return _rows({label: [max(run.curve.items()) for run in own] for label, own in groups.items()})


def _rows(points: Mapping[str, Sequence[tuple[int, float]]]) -> list[Row]:
    """A row per label of (step, score)s."""
    scores = {label: [score for _, score in own] for label, own in points.items()}
    found = {label: summarize(own) for label, own in scores.items()}
    best = max(found, key=lambda label: found[label].mean, default=None)
    rows = []
    for label, own in points.items():
        steps = [step for step, _ in own]
        beaten = None if best is None or label == best else probability_of_improvement(scores[best], scores[label])
        rows.append(Row(label, (min(steps), max(steps)), found[label], beaten))
    return rows


def table(rows: Sequence[Row]) -> list[str]:
    """Lines that say what each group reached at a step; none without a row."""
    if not rows:
        return []
    several = any(row.summary.seeds > 1 for row in rows)
    names = "mean ± std, interquartile mean [95 % interval]" if several else "of one run"
    names += f", and how often {best_of(rows)} is better" if len(rows) > 1 else ""
    lines = [f"return at {rows[0].steps[1]:,} steps: {names}"]
    for row in rows:
        found = row.summary
        spread = f" ± {found.std:,.1f}" if found.seeds > 1 else ""
        interval = f", {found.interquartile_mean:,.1f} [{found.low:,.1f}, {found.high:,.1f}]" if found.seeds > 1 else ""
        beaten = "" if row.beaten is None else f", {row.beaten:.0%}"
        count = f"{found.seeds} run{'s' * (found.seeds > 1)}"
        lines.append(f"  {row.label} ({count}): {found.mean:,.1f}{spread}{interval}{beaten}")
    return lines


def cells(found: Summary) -> list[str]:
    """Mean, deviation, interquartile mean and its interval, as text; of a single run only the mean is known."""
    if found.seeds < 2:
        return [f"{found.mean:,.1f}", "", "", ""]
    rest = f"{found.interquartile_mean:,.1f}", f"{found.low:,.1f} to {found.high:,.1f}"
    return [f"{found.mean:,.1f}", f"{found.std:,.1f}", *rest]


def best_of(rows: Sequence[Row]) -> str:
    """Label of the group with the highest mean."""
    return next(row.label for row in rows if row.beaten is None)


def _some(steps: list[int]) -> str:
    return ", ".join(map(str, steps if len(steps) < 8 else [*steps[:3], "...", *steps[-3:]]))
