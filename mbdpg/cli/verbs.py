"""The verbs: train, resume, evaluate, demonstrate, benchmark."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from mbdpg import envs
from mbdpg.cli.flags import parse, peek, program
from mbdpg.cli.report import report
from mbdpg.cli.reproduce import reproduce
from mbdpg.experiments import benchmark, expert, presets
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import AgentConfig, EnvOptions, RunConfig
from mbdpg.experiments.run import load_policy, resume, train
from mbdpg.experiments.stopping import Stop
from mbdpg.interfaces import require
from mbdpg.reports.console import RunDisplay
from mbdpg.reports.curves import draw_curves
from mbdpg.reports.video import VideoWriter
from mbdpg.storage.files import replace_durably
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.evaluation import evaluate
from mbdpg.training.loop import Schedule

EnvArgument = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ENV")]
RunArgument = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]


@dataclass(frozen=True)
class RunOptions:
    """What is run."""

    algorithm: Literal["mbdpg", "td3", "sac", "pets", "mbpo"] = "mbdpg"
    """Algorithm to train."""
    preset: presets.Preset = "default"
    """Settings that measured best, or those published; other flags change single ones."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds; each is a run of its own, all in this process."""
    out: Path | None = None
    """Folder that gets one run folder per seed; by default runs/ENV-ALGORITHM-TIME."""
    demonstrations: str = "none"
    """File to begin from (see mbdpg demonstrate), `expert` to make one first, or `none`."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Resume:
    """Go on with a run, or with all runs in a folder, exactly where they stopped."""

    run: RunArgument
    """Run folder, or a folder of run folders."""
    steps: int | None = None
    """Environment steps of the whole run, to make it longer than planned."""
    allow_import: bool = False
    """Allow the run's environment id to import code (module:Id)."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Evaluate:
    """Run a learned policy without exploration, and film it if asked to; no display is needed."""

    run: RunArgument
    """Run folder."""
    episodes: int = 10
    """Number of episodes."""
    best: bool = False
    """Use the policy with the best evaluation in training instead of the latest."""
    video: Path | None = None
    """MP4 file to write the first episode to."""
    seed: int = 0
    """Decides the episodes."""
    allow_import: bool = False
    """Allow the run's environment id to import code (module:Id)."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Demonstrate:
    """Train an expert with TD3, or take one from a run, and record its successful episodes (Section 4.2)."""

    env: EnvArgument
    """Gymnasium id, as in HalfCheetah-v5."""
    out: Path
    """File to write, for example demonstrations.safetensors; the expert's run is kept in demonstrations-expert/."""
    steps: int = 200_000
    """Environment steps of the expert's training."""
    expert: Path | None = None
    """Run folder of an expert that is trained already, by any algorithm; else TD3 is trained."""
    episodes: int = 10
    """Successful episodes to record."""
    success_return: float | None = None
    """Least return of a success; by default what the environment is known to need."""
    seed: int = 0
    """Random seed of the expert and of its episodes."""
    env_options: tyro.conf.OmitArgPrefixes[EnvOptions] = field(default_factory=EnvOptions)
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Benchmark:
    """Measure on this machine: updates at the paper's sizes, acting, starting, memory. A few minutes."""

    json: Path | None = None
    """File that gets all numbers."""
    quick: bool = False
    """Leave out how the time grows with horizon, batch, width and seeds."""
    debug: bool = False
    """Show the traceback of an error."""


def _train_flags(args: list[str], preset: str, agent: AgentConfig) -> Any:
    """What `mbdpg train` is told, over a preset's settings."""
    schedule, env_options = presets.run_settings(preset)
    flat = tyro.conf.OmitArgPrefixes
    command = dataclasses.make_dataclass(
        "Train",
        [
            ("env", Annotated[EnvArgument, tyro.conf.arg(help="Gymnasium id, as in HalfCheetah-v5.")]),
            ("run", flat[RunOptions], field(default_factory=RunOptions)),
            ("schedule", flat[Schedule], field(default=schedule)),
            ("env_options", flat[EnvOptions], field(default=env_options)),
            ("agent", flat[type(agent)], field(default=agent)),
        ],
        frozen=True,
    )
    command.__doc__ = "Learn a policy for a Gymnasium environment."
    return parse(command, "train", args)


def _train(args: list[str]) -> None:
    algorithm = peek(args, "algorithm", "mbdpg")
    preset = peek(args, "preset", "default")
    agent = presets.agent_config(algorithm, preset, args[0] if args else None)
    flags = _train_flags(args, preset, agent)
    own = presets.agent_config(algorithm, preset, flags.env)
    if own != agent:  # the task's id stands elsewhere
        flags = _train_flags(args, preset, own)
    keep_compilations()
    config = RunConfig(flags.env, flags.agent, flags.schedule, flags.env_options)
    name = re.sub(r"[^A-Za-z0-9.-]+", "-", flags.env)
    out = flags.run.out or Path("runs") / f"{name}-{algorithm}-{time.strftime('%Y%m%d-%H%M%S')}"
    if flags.run.demonstrations == "expert":
        file = out / "demonstrations.safetensors"
        make_demonstrations(Demonstrate(flags.env, file, seed=flags.run.seeds[0], env_options=flags.env_options))
        config = dataclasses.replace(config, demonstrations=str(file))
    elif flags.run.demonstrations != "none":
        config = dataclasses.replace(config, demonstrations=flags.run.demonstrations)
    with Stop() as stop:
        with RunDisplay(config.schedule.steps) as display:
            runs = train(config, seeds=flags.run.seeds, out=out, on_update=display, should_stop=stop)
        stop.exit_if_asked(f"{program()} resume {out}")
    _finish(runs, algorithm, config.env)


def _finish(runs: Sequence[Path], algorithm: str, env: str) -> None:
    """Draw the learning curve beside the run folders and say what to do next."""
    folder = runs[0].parent
    draw_curves({algorithm: runs}, folder / "learning-curve.png", title=env)
    print(f"done: {folder}, learning curve in {folder / 'learning-curve.png'}")
    print(f"next: {program()} evaluate {runs[0]} --episodes 10 --video {folder / 'policy.mp4'}")


def _resume(args: list[str]) -> None:
    flags = parse(Resume, "resume", args)
    keep_compilations()
    runs = [flags.run]
    if flags.run.is_dir() and not (flags.run / "config.json").exists():
        runs = sorted(path.parent for path in flags.run.glob("seed-*/config.json")) or runs
    with Stop() as stop:
        for run in runs:
            with contextlib.ExitStack() as stack:

                def display(
                    config: RunConfig, env_steps: int, run: Path = run, stack: contextlib.ExitStack = stack
                ) -> RunDisplay:
                    if env_steps >= config.schedule.steps:
                        print(f"{run} has its {env_steps:,} steps already; --steps makes it longer")
                    return stack.enter_context(RunDisplay(config.schedule.steps, done=env_steps))

                resume(run, steps=flags.steps, allow_import=flags.allow_import, watch=display, should_stop=stop)
            stop.exit_if_asked(f"{program()} resume {flags.run}")
    config = RunFolder.open(runs[0]).config
    _finish(runs, config["algorithm"], config["env"])


def _evaluate(args: list[str]) -> None:
    flags = parse(Evaluate, "evaluate", args)
    require(flags.episodes >= 1, f"--episodes is {flags.episodes}, expected at least 1")
    require(flags.seed >= 0, f"--seed is {flags.seed}, expected at least 0")
    folder = RunFolder.open(flags.run)
    config = RunConfig.from_json(folder.config)
    require(not folder.config.get("custom_env"), f"{flags.run} trained an environment made in code: use mbdpg.evaluate")
    # Nobody but the person at the keyboard may decide that code is imported.
    options = dataclasses.replace(config.env_options, allow_import=flags.allow_import)
    seeds = [envs.episode_seed(flags.seed, "test", i) for i in range(flags.episodes)]
    env = dataclasses.replace(config, env_options=options).make_env(render=flags.video is not None)
    policy = load_policy(flags.run, best=flags.best, spec=env.spec)
    returns, lengths = [], []
    for episode, seed in enumerate(seeds):
        with contextlib.ExitStack() as stack:
            film = None
            if flags.video is not None and episode == 0:
                film = stack.enter_context(VideoWriter(flags.video, frames_per_second=env.frames_per_second))
            outcome = evaluate(env, policy, [seed], on_frame=film)
        returns += outcome.returns
        lengths += outcome.lengths
        if outcome.returns:
            print(f"episode {episode}: return {outcome.returns[0]:.1f}, {outcome.lengths[0]} steps")
    env.close()
    require(len(returns) > 0, f"{config.env} failed in every episode (see above): mend it, then evaluate again")
    mean, spread, length = np.mean(returns), np.std(returns), np.mean(lengths)
    print(f"{len(returns)} episode{'s' * (len(returns) > 1)}: return {mean:.1f} ± {spread:.1f}, {length:.0f} steps")
    if flags.video is not None:
        print(f"video of the first episode in {flags.video}")


def _demonstrate(args: list[str]) -> None:
    flags = parse(Demonstrate, "demonstrate", args)
    keep_compilations()
    make_demonstrations(flags)


def make_demonstrations(flags: Demonstrate) -> None:
    """Train the expert unless there is one, then record."""
    require(flags.episodes >= 1, f"--episodes is {flags.episodes}, expected at least 1")
    success = expert.success_in(flags.env, flags.env_options, flags.success_return)
    run = flags.expert
    if run is None:
        folder = flags.out.parent / f"{flags.out.stem}-expert"
        trained = folder / f"seed-{flags.seed}"
        require(
            not trained.exists(),
            f"{trained} has an expert already: take it with --expert {trained}, after more training if it needs that "
            f"(mbdpg resume {trained} --steps N), or choose another --out",
        )
        config = expert.config_of(flags.env, flags.steps, flags.env_options)
        with Stop() as stop:
            with RunDisplay(flags.steps) as display:
                run = train(config, seeds=[flags.seed], out=folder, on_update=display, should_stop=stop)[0]
            stop.exit_if_asked(
                f"mbdpg resume {run}, then mbdpg demonstrate {flags.env} --out {flags.out} --expert {run}"
            )
    found = expert.record_from(
        run,
        flags.env,
        flags.env_options,
        episodes=flags.episodes,
        success_return=success,
        seed=flags.seed,
    )
    found.save(flags.out)
    returns = found.facts["returns"]
    print(f"{len(returns)} of {found.facts['tried']} episodes were successes, mean return {np.mean(returns):.1f}")
    print(f"demonstrations in {flags.out}; they cost {found.expert_env_steps} environment steps")


def _benchmark(args: list[str]) -> None:
    flags = parse(Benchmark, "benchmark", args)
    file = flags.json
    if file is not None:
        fits = os.access(file.absolute().parent, os.W_OK) and not file.is_dir()
        require(fits, f"--json is {file}, expected a file in a folder that can be written to")
    measured = benchmark.benchmark(lambda line: print(line, flush=True), growth=not flags.quick)
    if file is not None:
        replace_durably(file, json.dumps(measured, indent=2).encode())
        print(f"all numbers in {file}")


VERBS = {
    "train": _train,
    "resume": _resume,
    "evaluate": _evaluate,
    "demonstrate": _demonstrate,
    "reproduce": reproduce,
    "report": report,
    "benchmark": _benchmark,
}
