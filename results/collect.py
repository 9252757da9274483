"""Copy the evaluations of run folders into one CSV and draw them: python results/collect.py NAME RUN..."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

from mbdpg.reports.curves import draw_curves
from mbdpg.storage.metrics import read_metrics
from mbdpg.storage.run_folder import RunFolder

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


def collect(name: str, runs: list[Path]) -> None:
    """Write NAME.csv and NAME.png beside this file, and print where the runs come from."""
    here = Path(__file__).parent
    with open(here / f"{name}.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["env", "algorithm", "seed", *COLUMNS])
        for run in runs:
            config = RunFolder.open(run).config
            print({key: config[key] for key in ("env", "algorithm", "seed", "commit")}, config["machine"]["cpu"])
            rows = read_metrics(run, "eval")
            absent = [None] * len(rows["env_steps"])
            for row in zip(*(rows.get(column, absent) for column in COLUMNS), strict=True):
                shown = [f"{value:.6g}" if isinstance(value, float) else value for value in row]
                writer.writerow([config["env"], config["algorithm"], config["seed"], *shown])
    config = RunFolder.open(runs[0]).config
    draw_curves({config["algorithm"]: runs}, here / f"{name}.png", title=config["env"])


if __name__ == "__main__":
    collect(sys.argv[1], [Path(run) for run in sys.argv[2:]])
