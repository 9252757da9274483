"""MBDPG beside its peers on this machine, in turns within one invocation.

    .venv/bin/python benchmarks/side_by_side.py --out speed.csv                  # after `make setup-dev peers`
    .venv/bin/python benchmarks/side_by_side.py --train 10000 --out speed.csv

First the update of actor and critics at the paper's sizes against the same in eager torch, which is checked to compute
the same. With --train, then whole trainings on HalfCheetah-v5 of so many steps: MBDPG, our TD3 and SAC with their
authors' settings, and Stable-Baselines3's.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mbdpg.agents.mbdpg import MBDPG
from mbdpg.experiments.benchmark import PAPER_SIZES, TASK, made_up_batches, made_up_learner, update_ms
from mbdpg.interfaces import phase_of
from mbdpg.storage.metrics import read_metrics
from mbdpg.storage.run_folder import describe_machine
from mbdpg.training.learner import Learner

HERE = Path(__file__).parent
TOLERANCE = 1e-3


def given_to(peer: Path, learner: Learner) -> Any:
    """Write networks and a batch for the peer; returns the batch."""
    agent = learner.agent
    assert isinstance(agent, MBDPG)
    phase = phase_of(agent, "improving")
    batches = made_up_batches(phase, 1)
    state, batch = (jax.tree.map(lambda x: x[0], tree) for tree in (learner.state, batches))
    window = state.window(batch)
    arrays = {
        name: value
        for name, value in learner.snapshot(0).items()
        if "optimizer" not in name and value.dtype == np.float32 and not name.startswith(("imagined", "dynamics"))
    }
    windows = {f"window/{name}": np.asarray(value) for name, value in window._asdict().items()}
    settings = {name: value for name, value in vars(agent.config).items() if isinstance(value, int | float)}
    texts = {"settings": json.dumps(settings), "names": json.dumps(list(window._fields))}
    np.savez(peer, **arrays, **windows, **{k: np.frombuffer(v.encode(), np.uint8) for k, v in texts.items()})
    return batches


def check(learner: Learner, batches: Any, theirs: dict[str, Any]) -> None:
    """Take the peer's first update, and compare its losses, the norms of its gradients and of every parameter after it.

    Raises:
        SystemExit: they do not compute the same.
    """
    metrics = learner.update(phase_of(learner.agent, "improving"), [batches], 0)
    after = learner.snapshot(0)
    ours = {name: float(metrics[name][0]) for name in theirs["first"]}
    ours |= {name: float(np.linalg.norm(after[name].astype(np.float64))) for name in theirs["norms"]}
    for name, value in (theirs["first"] | theirs["norms"]).items():
        if abs(ours[name] - value) > TOLERANCE * max(abs(value), 1e-3):
            raise SystemExit(f"{name} is {ours[name]:.6g} here and {value:.6g} in eager torch")


def updates(python: Path, rounds: int, threads: int) -> list[list[Any]]:
    """Milliseconds of one update, ours and eager torch's in turns."""
    learner = made_up_learner(dataclasses.replace(PAPER_SIZES, target_noise=0.0))
    # Fresh critics are zero everywhere, where nothing could be compared.
    rng, snapshot = np.random.default_rng(0), learner.snapshot(0)
    for name, value in snapshot.items():
        if "critics/mlps/output" in name and "optimizer" not in name:
            snapshot[name] = rng.normal(0, 0.1, value.shape).astype(np.float32)
    learner.restore([snapshot])
    rows: list[list[Any]] = []
    with tempfile.TemporaryDirectory() as place:
        given = Path(place) / "given.npz"
        batches = given_to(given, learner)
        command = [str(python), str(HERE / "eager.py"), str(given), "--threads", str(threads)]
        for turn in range(rounds):
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            theirs = json.loads(done.stdout)
            if turn == 0:
                check(learner, batches, theirs)
            rows.append(["update", "eager torch", turn, f"{theirs['ms']:.1f}", "ms"])
            rows.append(
                ["update", "mbdpg", turn, f"{update_ms(learner, phase_of(learner.agent, 'improving')):.1f}", "ms"]
            )
            print(*rows[-2], *rows[-1], flush=True)
    return rows


def trainings(python: Path, steps: int, rounds: int, threads: int) -> list[list[Any]]:
    """Seconds of whole trainings, start and evaluations included, and what they came to."""
    rows: list[list[Any]] = []
    with tempfile.TemporaryDirectory() as place:
        common = ["--steps", str(steps), "--evaluate-every", str(min(steps, 5000))]
        ours = [sys.executable, "-m", "mbdpg", "train", TASK, *common]
        peer = [str(python), str(HERE / "peers.py")]
        few = ["--random-steps", "4000"]
        commands = {"mbdpg": ours}
        for name in ("td3", "sac"):
            commands[f"our {name}"] = [*ours, "--algorithm", name, "--preset", "paper", *few]
            commands[f"Stable-Baselines3 {name}"] = [*peer, name, TASK, *common, *few, "--threads", str(threads)]
        for turn in range(rounds):
            for name, command in commands.items():
                out = Path(place) / f"{name}-{turn}".replace(" ", "-")
                began = time.monotonic()
                subprocess.run([*command, "--out", str(out)], check=True, stdout=subprocess.DEVNULL)
                rows.append([f"{steps:,} steps", name, turn, f"{time.monotonic() - began:.0f}", "s"])
                rows.append([f"{steps:,} steps", name, turn, f"{last_return(out):.0f}", "return"])
                print(*rows[-2], *rows[-1], flush=True)
    return rows


def last_return(out: Path) -> float:
    """Of the last evaluation in our run folder, or in the peer's table."""
    if out.is_dir():
        return float(read_metrics(out / "seed-0", "eval")["eval/return_mean"][-1])
    with open(out, newline="") as file:
        return float(list(csv.DictReader(file))[-1]["return_mean"])


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--train", type=int, default=0, metavar="STEPS")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--peers", type=Path, default=Path(".venv-peers/bin/python"), help="has torch")
    flags = parser.parse_args()
    if flags.train % 5000 and flags.train > 5000:
        parser.error(f"--train is {flags.train}, expected a multiple of 5,000, where all are evaluated")
    threads = len(os.sched_getaffinity(0))
    rows = updates(flags.peers, flags.rounds, threads)
    if flags.train:
        rows += trainings(flags.peers, flags.train, flags.rounds, threads)
    machine = json.dumps(describe_machine())
    with open(flags.out, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("what", "program", "turn", "value", "unit", "machine"))
        writer.writerows([*row, machine] for row in rows)
    times = {
        program: [float(row[3]) for row in rows if row[:2] == ["update", program]]
        for program in ("mbdpg", "eager torch")
    }
    ours, theirs = (float(np.median(times[program])) for program in ("mbdpg", "eager torch"))
    print(f"one update: {ours:.1f} ms, eager torch {theirs:.1f} ms: {ours / theirs:.2f} of it")


if __name__ == "__main__":
    main()
