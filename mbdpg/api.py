"""The library: the command line's verbs as typed calls, for registered environments and for your own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, SupportsIndex

import numpy as np

from mbdpg import envs
from mbdpg.dynamics.planning import PlanningPolicy
from mbdpg.experiments import resuming, run
from mbdpg.experiments.config import CONFIGS, AgentConfig, EnvOptions, RunConfig
from mbdpg.experiments.presets import agent_config
from mbdpg.interfaces import Environment, require
from mbdpg.networks.policy import NumpyPolicy
from mbdpg.training.evaluation import Evaluation, evaluate as run_episodes
from mbdpg.training.loop import Schedule, Update

Env = str | envs.MakeGymnasium
"""A Gymnasium id, or a function that makes an environment."""


def train(
    env: Env,
    *,
    config: AgentConfig | None = None,
    schedule: Schedule | None = None,
    seeds: Iterable[SupportsIndex] = (0,),
    out: str | Path,
    demonstrations: str | Path | None = None,
    reference_return: float | None = None,
    on_evaluation: Callable[[Update], None] | None = None,
) -> list[Path]:
    """Train an agent; its config's type says which.

    Args:
        env: a Gymnasium id, or a function that makes an environment (called a few times).
        config: the agent's settings; by default `agent_config(env=env)`, those that `mbdpg train` has for this task.
        schedule: length of the run, and how often it evaluates and saves.
        seeds: one run each, all in this process.
        out: a folder that gets one run folder `seed-<seed>` per seed.
        demonstrations: a file that `mbdpg demonstrate` wrote.
        reference_return: undiscounted return at which the task is solved; exploration noise falls on the way there.
            By default what Gymnasium or we know of an id; where nothing is known, noise stays as it is and
            `huber_delta` does nothing.
        on_evaluation: called after every evaluation.

    Returns:
        The run folders.

    Raises:
        UserError: something you can mend, said in one line.
    """
    make_env = _maker(env)
    require(isinstance(seeds, Iterable), f"seeds is {seeds}, expected a list of numbers, as in [{seeds}]")
    agent = agent_config(env=env if isinstance(env, str) else None) if config is None else config
    kinds = tuple(CONFIGS.values())
    given = agent.__name__ if isinstance(agent, type) else type(agent).__name__
    require(type(agent) in kinds, f"config is {given}, expected an MBDPGConfig(...) or a rival's, made by calling it")
    settings = RunConfig(
        env=env if isinstance(env, str) else _name(env) or "environment made in code",
        agent=agent,
        schedule=schedule or Schedule(),
        env_options=EnvOptions(reference_return=reference_return),
        demonstrations=None if demonstrations is None else str(demonstrations),
    )
    return run.train(
        settings, seeds=seeds, out=Path(out), make_env=make_env, on_update=_only_evaluations(on_evaluation)
    )


def resume(
    path: str | Path,
    *,
    env: envs.MakeGymnasium | None = None,
    steps: int | None = None,
    on_evaluation: Callable[[Update], None] | None = None,
) -> None:
    """Go on with a run exactly where it stopped.

    Args:
        path: the run folder.
        env: makes the environment, if the run was given such a function.
        steps: environment steps of the whole run, if it shall be longer than planned.
        on_evaluation: called after every evaluation.

    Raises:
        UserError: not a run, or damaged beyond its checkpoints.
    """
    on_update = _only_evaluations(on_evaluation)
    make_env = None if env is None else _maker(env)
    resuming.resume([Path(path)], make_env=make_env, steps=steps, watch=lambda *_: on_update)


def load_policy(path: str | Path, *, best: bool = False) -> NumpyPolicy | PlanningPolicy:
    """The policy of a run: a function from one raw observation to one action in [-1, 1].

    In NumPy alone, but for PETS, which plans with JAX and whose `reset()` is to be called when an episode begins.

    Args:
        path: the run folder.
        best: the policy with the best evaluation, instead of the latest.

    Raises:
        UserError: there is none, or it is damaged.
    """
    return run.load_policy(Path(path), best=best)


def evaluate(env: Env, policy: Callable[[np.ndarray], np.ndarray], *, episodes: int = 10, seed: int = 0) -> Evaluation:
    """Run episodes without exploration; they are others than those of the evaluations in training.

    Args:
        env: a Gymnasium id, or a function that makes an environment.
        policy: actions in [-1, 1] from raw observations.
        episodes: how many.
        seed: decides the episodes' own seeds.

    Raises:
        UserError: an argument is wrong, or an action is not finite or of another shape than the environment's.
    """
    make = _maker(env)
    require(episodes >= 1, f"episodes is {episodes}, expected at least 1")
    require(seed >= 0, f"seed is {seed}, expected at least 0")
    made = envs.make(str(env)) if make is None else make()
    try:
        return run_episodes(made, policy, [envs.episode_seed(seed, "test", i) for i in range(episodes)])
    finally:
        made.close()


def _maker(env: Any) -> Callable[[], Environment] | None:
    """A function that makes the environment and wraps it; None for a registered one."""
    if isinstance(env, str):
        return None
    given = type(env).__name__
    require(callable(env), f"env is {given}, expected a Gymnasium id or a function that makes an environment")
    return lambda: envs.wrap(env(), name=_name(env))


def _name(env: envs.MakeGymnasium) -> str | None:
    """What to call an environment: its class's name or, for a function that has none of its own, nothing."""
    name = getattr(env, "__name__", None)
    return None if name == "<lambda>" else name


def _only_evaluations(on_evaluation: Callable[[Update], None] | None) -> Callable[[Update], None]:
    def on_update(update: Update) -> None:
        if on_evaluation is not None and update.evaluation is not None:
            on_evaluation(update)

    return on_update
