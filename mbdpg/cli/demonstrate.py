"""`mbdpg demonstrate`: an expert and its successes."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from mbdpg.cli.flags import EnvArgument, imports, parse, program
from mbdpg.experiments import expert
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import EnvOptions
from mbdpg.experiments.run import train
from mbdpg.experiments.stopping import Stop
from mbdpg.interfaces import require
from mbdpg.reports.console import RunDisplay
from mbdpg.storage.files import require_place
from mbdpg.storage.run_folder import RunFolder


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


def demonstrate(args: list[str]) -> None:
    """Run the verb."""
    flags = parse(Demonstrate, "demonstrate", args)
    keep_compilations()
    make_demonstrations(flags, args)


def make_demonstrations(flags: Demonstrate, args: Sequence[str], *, then: str = "") -> None:
    """Train the expert unless there is one, then record.

    Args:
        flags: what is wanted.
        args: what makes the same of `mbdpg demonstrate`, to be said where it is interrupted.
        then: what is to be done after that.
    """
    require(0 <= flags.seed < 2**31, f"--seed is {flags.seed}, expected a whole number from 0 to 2^31 - 1")
    require(flags.episodes >= 1, f"--episodes is {flags.episodes}, expected at least 1")
    success = expert.success_in(flags.env, flags.env_options, flags.success_return)
    config = expert.config_of(flags.env, flags.steps, flags.env_options)
    folder = flags.out.parent / f"{flags.out.stem}-expert"
    run = flags.expert or folder / f"seed-{flags.seed}"
    resume = shlex.join([program(), "resume", str(run), *imports(flags.env_options)])
    if flags.expert:
        RunFolder.open(run)
    require(
        flags.expert is not None or not run.exists(),
        f"{run} has an expert already: take it with --expert {shlex.quote(str(run))}, after more training if it needs "
        f"that ({resume} --steps N), or choose another --out",
    )
    require_place(flags.out, "--out")
    if flags.expert is None:
        with Stop() as stop:
            with RunDisplay(flags.steps) as display:
                train(config, seeds=[flags.seed], out=folder, on_update=display, should_stop=stop)
            again = shlex.join([*args, "--expert", str(run)])
            stop.exit_if_asked(f"{resume}, then {program()} demonstrate {again}{then}")
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
