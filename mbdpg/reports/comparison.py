"""Run folders side by side: which belong together, what sets groups apart, and what each reached at the same step."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mbdpg.interfaces import require
from mbdpg.reports.curves import learning_curve
from mbdpg.reports.statistics import probability_of_improvement, summarize
from mbdpg.storage.run_folder import RunFolder

LOOKS_ON = {"steps", "evaluate_every", "evaluation_episodes", "log_every", "checkpoint_every"}
"""Settings that change nothing of what is learned at a step."""


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


def grouped(runs: Sequence[Path]) -> dict[str, dict[str, list[Path]]]:
    """Runs of the same settings: for each environment, folders by a label that tells groups apart."""
    groups: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    settings: dict[str, dict[str, Any]] = {}
    for run in runs:
        config = RunFolder.open(run).config
        flat = {"algorithm": config.get("algorithm"), "demonstrations": config.get("demonstrations")}
        for part in ("agent", "env_options", "schedule"):
            values = config.get(part)
            flat |= values if isinstance(values, dict) else {}
        flat = {name: value for name, value in flat.items() if name not in LOOKS_ON}
        key = json.dumps(flat, sort_keys=True)
        settings[key] = flat
        groups[str(config.get("env"))][key].append(run)
    return {env: _labelled(own, settings) for env, own in groups.items()}


def _labelled(groups: dict[str, list[Path]], settings: dict[str, dict[str, Any]]) -> dict[str, list[Path]]:
    """Each group's algorithm, and those of its settings in which another group of that algorithm differs."""
    labels = {}
    for key, runs in groups.items():
        own = settings[key]
        peers = [settings[other] for other in groups if settings[other]["algorithm"] == own["algorithm"]]
        differing = sorted(name for name in own if any(peer.get(name) != own[name] for peer in peers))
        labels[" ".join([str(own["algorithm"]), *(f"{name}={own[name]}" for name in differing)])] = runs
    return labels


def table(groups: dict[str, list[Path]], *, at: int | None = None) -> list[str]:
    """Lines that say what each group reached.

    Args:
        groups: run folders by label.
        at: environment steps at which they are compared; by default the last at which all runs were evaluated.

    Raises:
        UserError: there is no step at which all runs were evaluated, or not that one.
    """
    curves = {label: [learning_curve(run) for run in runs] for label, runs in groups.items()}
    shared = set.intersection(*(set(curve) for own in curves.values() for curve in own))
    require(bool(shared), "these runs have no evaluation at the same step; train them further, or report fewer")
    step = max(shared) if at is None else at
    require(step in shared, f"--at is {step}, expected a step at which all were evaluated: {_some(sorted(shared))}")
    scores = {label: [curve[step] for curve in own] for label, own in curves.items()}
    best = max(scores, key=lambda label: float(np.mean(scores[label])))
    names = "mean ± std, interquartile mean [95 % interval]"
    names += f", and how often {best} is better" if len(scores) > 1 else ""
    lines = [f"return at {step:,} steps: {names}"]
    for label, own in scores.items():
        found = summarize(own)
        spread = f" ± {found.std:,.1f}" if found.seeds > 1 else ""
        interval = f", {found.interquartile_mean:,.1f} [{found.low:,.1f}, {found.high:,.1f}]" if found.seeds > 1 else ""
        beaten = "" if label == best else f", {probability_of_improvement(scores[best], own):.0%}"
        count = f"{found.seeds} run{'s' * (found.seeds > 1)}"
        lines.append(f"  {label} ({count}): {found.mean:,.1f}{spread}{interval}{beaten}")
    return lines


def _some(steps: list[int]) -> str:
    return ", ".join(map(str, steps if len(steps) < 8 else [*steps[:3], "...", *steps[-3:]]))
