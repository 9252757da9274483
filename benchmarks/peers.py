"""Stable-Baselines3's TD3 and SAC with the settings of `mbdpg train --preset paper`, evaluated as we evaluate.

Runs in the environment that `make peers` builds, which has no mbdpg::

    .venv-peers/bin/python benchmarks/peers.py sac HalfCheetah-v5 --steps 50000 --seed 0 --out peers-sac.csv

Beside it, for the same curve of ours: mbdpg train HalfCheetah-v5 --algorithm sac --preset paper --steps 50000 --seeds 0
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise

RANDOM_STEPS = {"td3": 25_000, "sac": 10_000}
CYCLE = 50
"""Environment steps between rounds of as many updates, as in `mbdpg train`."""


def make_agent(algorithm: str, env: gymnasium.Env, seed: int, random_steps: int | None) -> TD3 | SAC:
    """The peer's agent with two layers of 256, batches of 256, steps of 3e-4 and targets that follow at 0.005."""
    shared = {
        "learning_rate": 3e-4,
        "batch_size": 256,
        "tau": 0.005,
        "gamma": 0.99,
        "learning_starts": RANDOM_STEPS[algorithm] if random_steps is None else random_steps,
        "train_freq": (CYCLE, "step"),
        "gradient_steps": CYCLE,
        "policy_kwargs": {"net_arch": [256, 256]},
        "seed": seed,
        "device": "cpu",
    }
    if algorithm == "sac":
        return SAC("MlpPolicy", env, **shared)
    actions = env.action_space.shape[0]
    noise = NormalActionNoise(np.zeros(actions), np.full(actions, 0.1))
    return TD3("MlpPolicy", env, action_noise=noise, **shared)


class Evaluations(BaseCallback):
    """Five episodes of the deterministic policy every so many steps, the same five each time, to a CSV file."""

    def __init__(self, env: str, every: int, first: tuple[str, ...], out: Path):
        super().__init__()
        self._env, self._every, self._first, self._out = gymnasium.make(env), every, first, out
        self._began, self._evaluating = time.monotonic(), 0.0

    def _on_training_start(self) -> None:
        self._evaluate()

    def _on_step(self) -> bool:
        if self.num_timesteps % self._every == 0:
            self._evaluate()
        return True

    def _evaluate(self) -> None:
        began = time.monotonic()
        learning = began - self._began - self._evaluating
        returns = [self._episode(seed) for seed in range(10_000, 10_005)]
        row = [*self._first, self.num_timesteps, f"{np.mean(returns):.1f}", f"{np.std(returns):.1f}", round(learning)]
        with open(self._out, "a", newline="") as file:
            csv.writer(file).writerow(row)
        print(*row, flush=True)
        self._evaluating += time.monotonic() - began

    def _episode(self, seed: int) -> float:
        observation, _ = self._env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            action, _ = self.model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = self._env.step(action)
            total, over = total + float(reward), terminated or truncated
        return total


def main() -> None:
    """Train one peer on one task with one seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithm", choices=("td3", "sac"))
    parser.add_argument("env")
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--random-steps", type=int, default=None)
    parser.add_argument("--evaluate-every", type=int, default=5000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    flags = parser.parse_args()
    torch.set_num_threads(flags.threads)
    if not flags.out.exists():
        columns = ("program", "env", "algorithm", "seed", "env_steps", "return_mean", "return_std", "learning_seconds")
        flags.out.write_text(",".join(columns) + "\r\n")
    agent = make_agent(flags.algorithm, gymnasium.make(flags.env), flags.seed, flags.random_steps)
    first = ("stable-baselines3", flags.env, flags.algorithm, str(flags.seed))
    agent.learn(flags.steps, callback=Evaluations(flags.env, flags.evaluate_every, first, flags.out))


if __name__ == "__main__":
    main()
