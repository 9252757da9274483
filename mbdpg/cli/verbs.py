"""The verbs, and those of them that have no file of their own: resume, evaluate, benchmark."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from mbdpg import envs
from mbdpg.cli.demonstrate import demonstrate
from mbdpg.cli.flags import parse, program
from mbdpg.cli.report import report
from mbdpg.cli.reproduce import reproduce
from mbdpg.cli.sweep import sweep
from mbdpg.cli.train import finish, train
from mbdpg.experiments import benchmark
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.resuming import resume
from mbdpg.experiments.run import load_policy
from mbdpg.experiments.stopping import Stop
from mbdpg.interfaces import require
from mbdpg.reports.console import RunDisplay
from mbdpg.reports.video import VideoWriter
from mbdpg.storage.files import replace_durably
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.evaluation import evaluate

RunArgument = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]


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
class Benchmark:
    """Measure on this machine: updates at the paper's sizes, acting, starting, memory. A few minutes."""

    json: Path | None = None
    """File that gets all numbers."""
    quick: bool = False
    """Leave out how the time grows with horizon, batch, width and seeds."""
    debug: bool = False
    """Show the traceback of an error."""


def _resume(args: list[str]) -> None:
    flags = parse(Resume, "resume", args)
    keep_compilations()
    runs = [flags.run]
    if flags.run.is_dir() and not (flags.run / "config.json").exists():
        runs = sorted(path.parent for path in flags.run.glob("*/config.json")) or runs
    with Stop() as stop:
        with contextlib.ExitStack() as displays:

            def display(going: Sequence[Path], config: RunConfig, env_steps: int) -> RunDisplay:
                displays.close()  # of those before
                if env_steps >= config.schedule.steps:
                    for run in going:
                        print(f"{run} has its {env_steps:,} steps already; --steps makes it longer")
                elif len(going) < len(runs):
                    print(f"going on with {', '.join(map(str, going))}", file=sys.stderr)
                return displays.enter_context(RunDisplay(config.schedule.steps, done=env_steps))

            resume(runs, steps=flags.steps, allow_import=flags.allow_import, watch=display, should_stop=stop)
        stop.exit_if_asked(f"{program()} resume {flags.run}")
    config = RunFolder.open(runs[0]).config
    finish(runs, config["algorithm"], config["env"])


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


def _benchmark(args: list[str]) -> None:
    flags = parse(Benchmark, "benchmark", args)
    file = flags.json
    if file is not None:
        fits = os.access(file.absolute().parent, os.W_OK) and not file.is_dir()
        require(fits, f"--json is {file}, expected a file in a folder that can be written to")

    def show(what: str, value: str, remark: str) -> None:
        print(f"{what:<28} {value:>14}  {remark}".rstrip(), flush=True)

    measured = benchmark.benchmark(show, growth=not flags.quick)
    if file is not None:
        replace_durably(file, json.dumps(measured, indent=2).encode())
        print(f"all numbers in {file}")


VERBS = {
    "train": train,
    "resume": _resume,
    "evaluate": _evaluate,
    "demonstrate": demonstrate,
    "reproduce": reproduce,
    "sweep": sweep,
    "report": report,
    "benchmark": _benchmark,
}
