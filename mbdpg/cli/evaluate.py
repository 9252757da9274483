"""`mbdpg evaluate`."""

from __future__ import annotations

import contextlib
import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mbdpg import envs
from mbdpg.cli.flags import RunArgument, parse
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.run import load_policy
from mbdpg.interfaces import require
from mbdpg.reports.video import VideoWriter
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training import evaluation


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


def evaluate(args: list[str]) -> None:
    """Run the verb."""
    flags = parse(Evaluate, "evaluate", args)
    require(flags.episodes >= 1, f"--episodes is {flags.episodes}, expected at least 1")
    require(flags.seed >= 0, f"--seed is {flags.seed}, expected at least 0")
    folder = RunFolder.open(flags.run)
    config = RunConfig.of(folder)
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
            outcome = evaluation.evaluate(env, policy, [seed], on_frame=film)
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
