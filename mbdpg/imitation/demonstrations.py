"""A file of successful episodes: plain arrays plus JSON."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mbdpg.envs import episode_seed
from mbdpg.interfaces import Environment, EnvSpec, UserError, require
from mbdpg.storage.array_file import read_array_file, write_array_file
from mbdpg.training.evaluation import evaluate
from mbdpg.training.replay import Replay


@dataclass(frozen=True)
class Demonstrations:
    """Steps of successful episodes, and what obtaining them cost."""

    replay: Replay
    env: str
    expert_env_steps: int
    """Environment steps that the expert learned from, and those of the episodes recorded or discarded."""
    facts: dict[str, Any]
    """Success rule, returns, episodes tried and seed."""

    def save(self, path: Path) -> None:
        """Write them.

        Raises:
            UserError: the file cannot be written.
        """
        facts = self.facts | {"env": self.env, "expert_env_steps": self.expert_env_steps}
        write_array_file(path, "demonstrations", self.replay.columns(), facts)

    @classmethod
    def load(cls, path: Path, spec: EnvSpec) -> Demonstrations:
        """Read a file that may come from a stranger.

        Raises:
            UserError: not a demonstration file, damaged, not finite, actions outside [-1, 1], or of other spaces.
        """
        columns, facts = read_array_file(path.resolve(), "demonstrations")
        env = str(facts.get("env"))[:80]
        require(env == spec.id, f"{path} has demonstrations of {env}, expected {spec.id}")
        steps = facts.get("expert_env_steps")
        if not isinstance(steps, int) or steps < 0:
            raise UserError(f"{path} does not say how many steps its expert took; expected a number of at least 0")
        replay = Replay.from_columns(columns)
        wanted = (spec.observation_size, spec.action_size)
        found = (columns["observation"].shape[1], columns["action"].shape[1])
        require(
            found == wanted,
            f"{path} has {found[0]} observation and {found[1]} action entries, but {spec.id} has {wanted[0]} and "
            f"{wanted[1]}; expected demonstrations of {spec.id}",
        )
        require(replay.size > 0, f"{path} has no steps; expected at least one successful episode")
        require(bool((np.abs(columns["action"]) <= 1.0).all()), f"{path} has actions outside [-1, 1]")
        replay.close_episode()
        return cls(replay, env, steps, facts)


def record(
    env: Environment,
    policy: Callable[[np.ndarray], np.ndarray],
    *,
    episodes: int,
    success_return: float,
    expert_env_steps: int,
    seed: int,
) -> Demonstrations:
    """Run the expert and keep the episodes whose return is at least the success rule's.

    Tries up to four times as many episodes as asked for.

    Raises:
        UserError: none of them succeeded.
    """
    kept = Replay(env.spec.observation_size, env.spec.action_size)
    returns: list[float] = []
    best, tried = -np.inf, 0
    while len(returns) < episodes and tried < 4 * episodes:
        outcome = evaluate(env, policy, [episode_seed(seed, "expert", tried)])
        tried += 1
        expert_env_steps += outcome.steps.size
        if not outcome.returns:
            continue  # the environment failed
        best = max(best, outcome.returns[0])
        if outcome.returns[0] >= success_return:
            kept.extend(outcome.steps.columns())
            returns.append(outcome.returns[0])
    require(best > -np.inf, f"{env.spec.id} failed in all {tried} episodes of the expert (see above): mend it first")
    if not returns:
        raise UserError(
            f"none of {tried} episodes of the expert was a success: the best return was {best:.1f}, expected at least "
            f"{success_return:.1f}; train the expert longer (mbdpg resume RUN --steps N) or lower --success-return, "
            "and give it with --expert RUN"
        )
    facts = {"success_return": success_return, "returns": returns, "tried": tried, "seed": seed}
    return Demonstrations(kept, env.spec.id, expert_env_steps, facts)
