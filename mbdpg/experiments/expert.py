"""Learning from success (Section 4.2): a TD3 expert, and what of its behavior is worth imitating."""

from __future__ import annotations

import math
from pathlib import Path

from mbdpg.experiments.config import EnvOptions, RunConfig
from mbdpg.experiments.presets import agent_config
from mbdpg.experiments.run import load_policy
from mbdpg.imitation.demonstrations import Demonstrations, record
from mbdpg.interfaces import UserError, require
from mbdpg.storage.metrics import read_metrics
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.loop import Schedule


def config_of(env: str, steps: int, env_options: EnvOptions) -> RunConfig:
    """The expert's training: TD3 for `steps` environment steps."""
    return RunConfig(env, agent_config("td3", "default"), Schedule(steps=steps), env_options)


def success_in(env: str, env_options: EnvOptions, given: float | None) -> float:
    """Least return of a success: what is given, or else the environment's reference return.

    Raises:
        UserError: nobody knows, or there is no such environment.
    """
    require(given is None or math.isfinite(given), f"--success-return is {given}, expected a finite number")
    made = RunConfig(env, env_options=env_options).make_env()
    made.close()
    success = made.spec.reference_return if given is None else given
    if success is None:
        raise UserError(f"nobody knows what a success in {env} is; say so with --success-return")
    return success


def record_from(
    run: Path,
    env: str,
    env_options: EnvOptions,
    *,
    episodes: int,
    success_return: float,
    seed: int,
) -> Demonstrations:
    """Record successful episodes of a run's best policy, by whatever algorithm it was trained.

    Args:
        run: the expert's run folder.
        env: Gymnasium id to record in.
        env_options: how it is made.
        episodes: successes to record.
        success_return: least return of a success.
        seed: decides the episodes.

    Raises:
        UserError: there was no success, it is no run, or its policy is for another environment.
    """
    RunFolder.open(run)
    made = RunConfig(env, env_options=env_options).make_env()
    try:
        policy = load_policy(run, best=True, spec=made.spec)
        evaluated = read_metrics(run, "eval")
        # Of a run that still goes on, the last row may have its time alone.
        rows = zip(evaluated["env_steps"], evaluated["expert_env_steps"], strict=True)
        steps, taught = [row for row in rows if row[1] is not None][-1]
        return record(
            made,
            policy,
            episodes=episodes,
            success_return=success_return,
            expert_env_steps=steps + taught,
            seed=seed,
        )
    finally:
        made.close()
