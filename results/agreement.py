"""Put run folders beside Stable-Baselines3's: python results/agreement.py PEERS.csv... RUN...

Writes peers.csv beside this file, every evaluation of both programs, and prints for each task and algorithm whether the
means at the last step that all seeds share differ by less than the pooled standard deviation over seeds.
"""

from __future__ import annotations

import csv
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from mbdpg.storage.metrics import read_metrics
from mbdpg.storage.run_folder import RunFolder

COLUMNS = ("program", "env", "algorithm", "seed", "env_steps", "return_mean", "return_std", "learning_seconds")


def rows_of_peer(path: Path) -> list[dict[str, str]]:
    """What benchmarks/peers.py wrote."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def rows_of_run(path: Path) -> list[dict[str, str]]:
    """The evaluations of a run folder in the same words."""
    config, rows = RunFolder.open(path).config, read_metrics(path, "eval")
    first = {"program": "mbdpg", "env": config["env"], "algorithm": config["algorithm"], "seed": str(config["seed"])}
    seconds = np.asarray(rows["time/seconds"]) - np.asarray(rows["time/evaluating"])
    columns = (rows["env_steps"], rows["eval/return_mean"], rows["eval/return_std"], seconds)
    return [
        first
        | {"env_steps": str(steps), "return_mean": f"{mean:.1f}", "return_std": f"{std:.1f}"}
        | {"learning_seconds": str(round(spent))}
        for steps, mean, std, spent in zip(*columns, strict=True)
    ]


def main(paths: list[Path]) -> None:
    """Collect, write, compare."""
    rows = [row for path in paths for row in (rows_of_peer(path) if path.suffix == ".csv" else rows_of_run(path))]
    with open(Path(__file__).parent / "peers.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    found: dict[tuple[str, str], dict[str, dict[str, dict[int, float]]]] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        curve = found[row["env"], row["algorithm"]][row["program"]].setdefault(row["seed"], {})
        curve[int(row["env_steps"])] = float(row["return_mean"])
    for (env, algorithm), programs in sorted(found.items()):
        curves = [curve for seeds in programs.values() for curve in seeds.values()]
        step = max(set.intersection(*map(set, curves)))
        both = (programs[program].values() for program in ("mbdpg", "stable-baselines3"))
        ours, peers = (np.array([curve[step] for curve in curves]) for curves in both)
        if min(len(ours), len(peers)) < 2:
            continue
        pooled = np.sqrt((np.var(ours, ddof=1) + np.var(peers, ddof=1)) / 2)
        apart = abs(ours.mean() - peers.mean())
        verdict = "agree" if apart < pooled else "DIFFER"
        print(f"{env} {algorithm} at {step:,}: apart {apart:.0f}, pooled std {pooled:.0f}: {verdict}")
        for name, returns in (("mbdpg", ours), ("stable-baselines3", peers)):
            each = np.round(returns).astype(int).tolist()
            print(f"  {name}: {returns.mean():.0f} ± {returns.std(ddof=1):.0f}, {each}")


if __name__ == "__main__":
    main([Path(path) for path in sys.argv[1:]])
