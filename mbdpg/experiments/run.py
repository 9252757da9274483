"""The composition root: everything a run consists of, built in one call."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import SupportsIndex

from mbdpg import envs
from mbdpg.agents import mbdpg, mbpo, pets, sac, td3
from mbdpg.dynamics.planning import PlanningPolicy, is_planner, planner_of
from mbdpg.experiments.config import EnvOptions, RunConfig
from mbdpg.experiments.origin import origin
from mbdpg.experiments.recorder import Recorder
from mbdpg.imitation.demonstrations import Demonstrations
from mbdpg.interfaces import Agent, Environment, EnvSpec, UserError, require
from mbdpg.networks.policy import NumpyPolicy
from mbdpg.storage.array_file import read_array_file
from mbdpg.storage.checkpoint import Checkpoint
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.collector import Collector
from mbdpg.training.learner import Learner
from mbdpg.training.loop import Training, Update
from mbdpg.training.randomness import checked_seeds
from mbdpg.training.replay import Replay

MakeEnvironment = Callable[[], Environment]
OnUpdate = Callable[[Update], None]


def train(
    config: RunConfig,
    *,
    seeds: Iterable[SupportsIndex],
    out: Path,
    make_env: MakeEnvironment | None = None,
    on_update: OnUpdate = lambda update: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> list[Path]:
    """Train from the beginning, all seeds in one process.

    Args:
        config: what to run.
        seeds: one run each.
        out: folder that gets one run folder, `seed-<seed>`, per seed.
        make_env: makes the environment, where it is not `config.env` from Gymnasium's registry.
        on_update: called after every cycle.
        should_stop: asked often; when it says yes, the run is saved and ended.

    Returns:
        The run folders.

    Raises:
        UserError: something the caller can mend; then no folder is left behind.
    """
    seeds = checked_seeds(seeds)
    if make_env is None:  # what is recorded is what is run
        config = dataclasses.replace(config, env=envs.current_id(config.env))
    make = make_env or config.make_env
    spec = spec_of(make, config.env_options)
    demonstrations = Demonstrations.load(Path(config.demonstrations), spec) if config.demonstrations else None
    description = config.to_json() | origin(len(seeds))
    folders: list[RunFolder] = []
    with contextlib.ExitStack() as undo, contextlib.ExitStack() as stack:
        for seed in seeds:
            facts = {"seed": seed, "custom_env": make_env is not None}
            folders.append(RunFolder.create(out / f"seed-{seed}", description | facts, undo=undo))
            stack.enter_context(folders[-1].locked())
        training = compose(config, spec, make, seeds, [Recorder(folder) for folder in folders], stack, demonstrations)
        training.save()
        undo.pop_all()  # from here on, there is something to go on from
        if config.schedule.steps <= config.agent.random_steps:
            print(
                f"mbdpg: nothing will be learned: all {config.schedule.steps:,} --steps are --random-steps "
                f"({config.agent.random_steps:,})",
                file=sys.stderr,
            )
        training.run(on_update, should_stop)
    return [folder.path for folder in folders]


def load_policy(path: Path, *, best: bool = False, spec: EnvSpec | None = None) -> NumpyPolicy | PlanningPolicy:
    """The policy of a run folder: its latest, or the one with the best evaluation.

    Raises:
        UserError: there is none, it is damaged, or it is not for the environment that `spec` describes.
    """
    name = path / "policy" / ("best.safetensors" if best else "latest.safetensors")
    if not name.is_file():
        raise UserError(f"{path} has no {name.name} yet; expected a run folder that has evaluated at least once")
    try:
        arrays = read_array_file(name, "policy")[0]
        policy = PlanningPolicy(planner_of(arrays)) if is_planner(arrays) else NumpyPolicy(arrays)
    except ValueError as error:
        raise UserError(f"{name} is not a policy: {error}") from error
    if spec is not None:
        sizes, wanted = (policy.observation_size, policy.action_size), (spec.observation_size, spec.action_size)
        require(
            sizes == wanted,
            f"the policy of {path} is for {sizes[0]} observation and {sizes[1]} action entries, but {spec.id} has "
            f"{wanted[0]} and {wanted[1]}; expected a run of {spec.id}",
        )
    return policy


def check_task(config: RunConfig) -> None:
    """Look that the environment and an agent for it can be made, before anything long begins.

    Raises:
        UserError: one cannot.
    """
    make_agent(config, spec_of(config.make_env, config.env_options))


def make_agent(config: RunConfig, spec: EnvSpec) -> Agent:
    """The agent that the config's type names."""
    match config.agent:
        case mbdpg.Config():
            return mbdpg.MBDPG(config.agent, spec)
        case td3.Config():
            return td3.TD3(config.agent, spec)
        case mbpo.Config():  # before SAC's, which they are too
            return mbpo.MBPO(config.agent, spec)
        case sac.Config():
            return sac.SAC(config.agent, spec)
        case pets.Config():
            return pets.PETS(config.agent, spec)


def compose(
    config: RunConfig,
    spec: EnvSpec,
    make: MakeEnvironment,
    seeds: Sequence[int],
    recorders: Sequence[Recorder],
    stack: contextlib.ExitStack,
    demonstrations: Demonstrations | None,
    checkpoints: Sequence[Checkpoint] = (),
) -> Training:
    """Put a run together, from the beginning or from a checkpoint of every seed."""
    for recorder in recorders:
        stack.callback(recorder.close)
    agent = make_agent(config, spec)
    collectors = []
    for index, seed in enumerate(seeds):
        replay = Replay(spec.observation_size, spec.action_size)
        if checkpoints:
            replay = Replay.from_columns(checkpoints[index].replay)
            replay.demonstrated = checkpoints[index].facts["demonstrated"]
        elif demonstrations:
            replay.extend(demonstrations.replay.columns())
            replay.demonstrated = replay.size
        collectors.append(
            Collector(
                make,
                seed,
                replay,
                random_steps=config.agent.random_steps,
                color=config.agent.exploration_color,
                scatter=config.agent.exploration_scatter,
            )
        )
        stack.callback(collectors[-1].close)
    training = Training(
        Learner(agent, seeds),
        collectors,
        make,
        recorders,
        config.schedule,
        expert_env_steps=demonstrations.expert_env_steps if demonstrations else 0,
    )
    if checkpoints:
        training.restore(checkpoints[0].env_steps, [c.arrays for c in checkpoints], [c.facts for c in checkpoints])
    return training


def spec_of(make: MakeEnvironment, options: EnvOptions) -> EnvSpec:
    """What an environment tells agents, asked of one that is closed again; it must end some time."""
    env = make()
    env.close()
    spec = options.override(env.spec)
    require(
        spec.episode_limit is not None,
        f"{spec.id} has no step limit, so an episode could go on for ever; set --max-episode-steps, or in code wrap it "
        "in gymnasium.wrappers.TimeLimit",
    )
    return spec
