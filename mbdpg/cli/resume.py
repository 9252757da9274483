"""`mbdpg resume`."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mbdpg.cli.flags import RunArgument, parse, program
from mbdpg.cli.train import finish
from mbdpg.experiments import resuming
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.stopping import Stop
from mbdpg.reports.console import RunDisplay


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


def resume(args: list[str]) -> None:
    """Run the verb."""
    flags = parse(Resume, "resume", args)
    keep_compilations()
    runs = [flags.run]
    if flags.run.is_dir() and not (flags.run / "config.json").exists():
        runs = sorted(path.parent for path in flags.run.glob("*/config.json")) or runs
    with Stop() as stop:
        with contextlib.ExitStack() as displays:

            def display(going: Sequence[Path], config: RunConfig, env_steps: int) -> RunDisplay:
                displays.close()  # of those before
                if flags.steps is None and env_steps >= config.schedule.steps:
                    for run in going:
                        print(f"{run} has its {env_steps:,} steps already; --steps makes it longer")
                elif len(going) < len(runs):
                    print(f"going on with {', '.join(map(str, going))}", file=sys.stderr)
                return displays.enter_context(RunDisplay(config.schedule.steps, done=env_steps))

            resuming.resume(runs, steps=flags.steps, allow_import=flags.allow_import, watch=display, should_stop=stop)
        stop.exit_if_asked(shlex.join([program(), "resume", *args]))
    finish(runs)
