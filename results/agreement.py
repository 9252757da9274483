"""Put run folders beside Stable-Baselines3's: python results/agreement.py PEERS.csv... RUN...

Writes peers.csv beside this file, every evaluation of both programs, and prints for each task and algorithm whether the
means at the end differ by less than the pooled standard deviation over seeds. A run is evaluated on episodes of its
seed's own; its last policy is played in the peer's episodes too, and that is compared, so that no episode's luck is.
"""

from __future__ import annotations

import contextlib
import csv
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.run import load_policy
from mbdpg.storage.metrics import read_metrics
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.evaluation import evaluate

OUT = Path(__file__).resolve().with_name("peers.csv")

EPISODES = range(10_000, 10_005)
"""Environment seeds of the peer's evaluation, benchmarks/peers.py."""

PAIRED = "mbdpg, in the peer's episodes"

COLUMNS = ("program", "env", "algorithm", "seed", "env_steps", "return_mean", "return_std", "learning_seconds")


def rows_of_peer(path: Path) -> list[dict[str, str]]:
    """What benchmarks/peers.py wrote."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def rows_of_run(path: Path) -> list[dict[str, str]]:
    """The evaluations of a run folder in the same words."""
    folder, rows = RunFolder.open(path), read_metrics(path, "eval")
    config = folder.config
    first = {"program": "mbdpg", "env": config["env"], "algorithm": config["algorithm"], "seed": str(config["seed"])}
    seconds = np.asarray(rows["time/seconds"]) - np.asarray(rows["time/evaluating"])
    columns = (rows["env_steps"], rows["eval/return_mean"], rows["eval/return_std"], seconds)
    own = [
        first
        | {"env_steps": str(steps), "return_mean": f"{mean:.1f}", "return_std": f"{std:.1f}"}
        | {"learning_seconds": str(round(spent))}
        for steps, mean, std, spent in zip(*columns, strict=True)
    ]
    settings = RunConfig.of(folder)
    with contextlib.closing(settings.make_env()) as env:
        returns = evaluate(env, load_policy(path), EPISODES).returns
    paired = own[-1] | {
        "program": PAIRED,
        "return_mean": f"{np.mean(returns):.1f}",
        "return_std": f"{np.std(returns):.1f}",
    }
    return [*own, paired]


def main(paths: list[Path]) -> None:
    """Collect, write, compare."""
    if not paths:
        raise SystemExit("nothing to compare; expected the files of benchmarks/peers.py and run folders")
    if any(path.resolve() == OUT for path in paths):
        raise SystemExit(f"{OUT.name} is what is written, expected the files of benchmarks/peers.py and run folders")
    rows = [row for path in paths for row in (rows_of_peer(path) if path.suffix == ".csv" else rows_of_run(path))]
    with open(OUT, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    last: dict[tuple[str, str], dict[str, dict[str, float]]] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        if row["program"] != "mbdpg":
            last[row["env"], row["algorithm"]][row["program"]][row["seed"]] = float(row["return_mean"])
    for (env, algorithm), programs in sorted(last.items()):
        both = (programs[program].values() for program in (PAIRED, "stable-baselines3"))
        ours, peers = (np.array(list(returns)) for returns in both)
        if min(len(ours), len(peers)) < 2:
            continue
        pooled = np.sqrt((np.var(ours, ddof=1) + np.var(peers, ddof=1)) / 2)
        apart = abs(ours.mean() - peers.mean())
        verdict = "agree" if apart < pooled else "DIFFER"
        print(f"{env} {algorithm}: apart {apart:.0f}, pooled std {pooled:.0f}: {verdict}")
        for name, returns in ((PAIRED, ours), ("stable-baselines3", peers)):
            each = np.round(returns).astype(int).tolist()
            print(f"  {name}: {returns.mean():.0f} ± {returns.std(ddof=1):.0f}, {each}")


if __name__ == "__main__":
    main([Path(path) for path in sys.argv[1:]])
