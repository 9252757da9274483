"""What the runs of a task came to, beside what others have published (published.csv).

    python results/collect.py NAME RUN...     # run folders; without any, what NAME.csv has already
    python results/collect.py                 # all tasks beside each other: overview.png

NAME.csv gets every evaluation of the runs, and keeps those of other seeds and algorithms; NAME.png has every seed's
curve and the mean over seeds, with our TD3 and SAC of peers.csv where NAME.csv has none. Printed are, per algorithm and
budget: seeds, mean, standard deviation, and interquartile mean with its 95 % bootstrap interval.
"""

from __future__ import annotations

import csv
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mbdpg.reports.curves import draw_seeds
from mbdpg.reports.statistics import summarize
from mbdpg.storage.files import replace_table
from mbdpg.storage.metrics import read_metrics
from mbdpg.storage.run_folder import RunFolder

HERE = Path(__file__).parent
BUDGETS = (50_000, 100_000)
TASKS = ("half_cheetah", "hopper", "ant", "bipedal_walker", "lunar_lander")
"""Files of overview.png, in its order."""
COLORS = {"mbdpg": "C0", "td3": "C1", "sac": "C2", "mbpo": "C3", "pets": "C4"}
WHOSE = ("env", "algorithm", "seed", "commit")
COLUMNS = (
    "env_steps",
    "eval/return_mean",
    "eval/return_std",
    "eval/length_mean",
    "time/seconds",
    "expert_env_steps",
    "dynamics/rmse_k05",
    "dynamics/persistence_k05",
    "dynamics/rmse_k20",
    "dynamics/persistence_k20",
    "dynamics/reward_bias",
    "dynamics/survival_imagined",
    "dynamics/survival_observed",
    "critic/q_bias",
    "critic/realized_return",
    "actor/grad_norm_k01",
    "actor/grad_norm_k05",
)

LINES, MARKS = ("-", "--", "-.", ":"), "osD^vP"
"""Of others' curves, and of single numbers of theirs."""

Curves = dict[str, dict[int, float]]
"""Return by environment step, by seed."""


def collect(name: str, runs: list[Path]) -> None:
    """Write the runs into NAME.csv, in the place of what it has of the same tasks, algorithms and seeds."""
    table = _rows(name) if (HERE / f"{name}.csv").exists() else []
    for run in runs:
        config = RunFolder.open(run).config
        commit = config["commit"] or ""
        short = commit[:7] + commit[40:]  # a plus follows where files had changed
        whose = {name: str(config[name]) for name in WHOSE[:3]} | {"commit": short}
        print(whose, config["machine"]["cpu"])
        table = [row for row in table if any(row[key] != whose[key] for key in WHOSE[:3])]
        columns = {name: values for name, values in read_metrics(run, "eval").items() if name in COLUMNS}
        for row in zip(*columns.values(), strict=True):
            table.append(whose | dict(zip(columns, map(_shown, row), strict=True)))
    table.sort(key=lambda row: (row["env"], row["algorithm"], int(row["seed"])))
    names = [*WHOSE, *COLUMNS]
    replace_table(HERE / f"{name}.csv", [names, *([row.get(name, "") for name in names] for row in table)])


def _shown(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def read(name: str) -> tuple[str, dict[str, Curves]]:
    """The task of NAME.csv, and learning curves by algorithm: its own, and of peers.csv those that it lacks."""
    own = _rows(name)
    env = own[0]["env"]
    curves = _curves(own, "eval/return_mean")
    ours = [row for row in _rows("peers") if row["env"] == env and row["program"] == "mbdpg"]
    return env, _curves(ours, "return_mean") | curves


def _rows(name: str) -> list[dict[str, str]]:
    with open(HERE / f"{name}.csv", newline="") as file:
        return list(csv.DictReader(file))


def _curves(rows: list[dict[str, str]], score: str) -> dict[str, Curves]:
    curves: dict[str, Curves] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        curves[row["algorithm"]][row["seed"]][int(row["env_steps"])] = float(row[score])
    return curves


def tell(curves: dict[str, Curves]) -> None:
    """Print a table row per algorithm and budget that some of its seeds have reached."""
    for algorithm, seeds in curves.items():
        for budget in BUDGETS:
            if scores := [curve[budget] for curve in seeds.values() if budget in curve]:
                s = summarize(scores)
                mean, middle = f"{s.mean:,.0f}", f"{s.interquartile_mean:,.0f}"
                if s.seeds > 1:
                    mean, middle = f"{mean} ± {s.std:,.0f}", f"{middle} [{s.low:,.0f}, {s.high:,.0f}]"
                print(f"| {algorithm} | {budget:,} | {s.seeds} | {mean} | {middle} |")


def _published(env: str) -> dict[tuple[str, str], list[tuple[int, float]]]:
    """Others' means over seeds of a task in any version: steps and return, by method and version."""
    others = defaultdict(list)
    for row in _rows("published"):
        if row["env"] == env.rpartition("-v")[0]:
            others[row["method"], row["id"]].append((int(row["env_steps"]), float(row["mean"])))
    return others


def _draw_ours(axes: Axes, curves: dict[str, Curves]) -> None:
    for algorithm, seeds in curves.items():
        draw_seeds(axes, [*seeds.values()], label=algorithm, color=COLORS[algorithm])
    axes.grid(alpha=0.3)


def _draw_published(axes: Axes, env: str, lines: Sequence[str], marks: Sequence[str], **drawn: Any) -> None:
    """A line for each method of others, but marks where it has one or two numbers only."""
    for number, ((method, version), points) in enumerate(_published(env).items()):
        line, mark = lines[number % len(lines)], marks[number % len(marks)]
        drawn |= {"linestyle": line, "marker": ""} if len(points) > 2 else {"linestyle": "", "marker": mark}
        axes.plot(*zip(*points, strict=True), label=f"{method} ({version}, published)", linewidth=1, **drawn)


def draw(name: str, env: str, curves: dict[str, Curves]) -> None:
    """Write NAME.png: our curves, and what others have published of theirs."""
    figure = Figure(figsize=(8, 6), layout="constrained")
    axes = figure.subplots()
    _draw_ours(axes, curves)
    _draw_published(axes, env, LINES, MARKS, color="0.35", fillstyle="none")
    axes.set(xlabel="environment steps", ylabel="evaluation return", title=env)
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")  # where it hides no curve
    figure.savefig(HERE / f"{name}.png", dpi=110)


def draw_overview() -> None:
    """Write overview.png: the same of all TASKS, what others have published in gray."""
    figure = Figure(figsize=(16, 3.6), layout="constrained")
    panels = figure.subplots(1, len(TASKS))
    panels[0].set_ylabel("evaluation return")
    seen = set()
    for axes, name in zip(panels, TASKS, strict=True):
        env, curves = read(name)
        _draw_ours(axes, curves)
        seen |= set(curves)
        _draw_published(axes, env, "-", "o", color="0.6", markersize=4)
        axes.set(title=env, xlabel="environment steps", xticks=range(0, 150_000, 50_000))
    lines = [Line2D([], [], color=color, label=f"{name}, here") for name, color in COLORS.items() if name in seen]
    lines.append(Line2D([], [], color="0.6", marker="o", markersize=4, label="others, as published"))
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines))
    figure.savefig(HERE / "overview.png", dpi=100)


def main(name: str, runs: list[Path]) -> None:
    """Collect the runs, if there are any, then tell and draw what NAME.csv has."""
    if runs:
        collect(name, runs)
    env, curves = read(name)
    tell(curves)
    draw(name, env, curves)


if __name__ == "__main__":
    if sys.argv[1:]:
        main(sys.argv[1], [Path(run) for run in sys.argv[2:]])
    else:
        draw_overview()
