"""`mbdpg sweep`: search for settings."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from mbdpg import envs
from mbdpg.cli.flags import default_folder, program, run_flags
from mbdpg.cli.places import Places, engine_of, made, say
from mbdpg.experiments import presets
from mbdpg.experiments.config import Algorithm, RunConfig
from mbdpg.experiments.run import check_task
from mbdpg.experiments.search import Search
from mbdpg.experiments.stopping import Stop
from mbdpg.experiments.sweep import sweep as search_settings
from mbdpg.interfaces import require
from mbdpg.training.randomness import checked_seeds


@dataclass(frozen=True)
class SweepOptions:
    """What is searched, and where."""

    algorithm: Algorithm = "mbdpg"
    """Algorithm to train."""
    preset: presets.Preset = "default"
    """Settings that measured best here, or those published; any other flag changes a single one."""
    search: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUES...")] = ()
    """Settings and their values: horizon=1:20, critic-learning-rate=1e-5:1e-3:log, gradient=full,eq19."""
    trials: int = 20
    """Choices of settings to train."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds of every trial, in one process; their mean counts."""
    prune: bool = True
    """Give a trial up whose best evaluation so far is below the median of completed trials at that step."""
    out: Path | None = None
    """Folder of the sweep; by default sweeps/ENV-ALGORITHM-TIME. A sweep goes on where it was."""
    places: tyro.conf.OmitArgPrefixes[Places] = field(default_factory=Places)
    debug: bool = False
    """Show the traceback of an error."""


def sweep(args: list[str]) -> None:
    """Run the verb."""
    flags: Any = run_flags("sweep", "Search for the settings that learn best, with Optuna.", SweepOptions, args)
    run = flags.run
    config = RunConfig(envs.current_id(flags.env), flags.agent, flags.schedule, flags.env_options)
    require(run.trials >= 1, f"--trials is {run.trials}, expected at least 1")
    require(len(run.search) > 0, "nothing is searched; say what with --search, for example --search horizon=1:20")
    checked_seeds(run.seeds)
    searches = [Search.parse(text, config.agent) for text in run.search]
    require(len({search.name for search in searches}) == len(searches), "--search has a setting twice")
    check_task(config)  # a wrong one is better said once than by every trial
    engine = engine_of(run.places)
    out = made(run.out or default_folder("sweeps", config), "the folder of a sweep")
    say(f"{run.trials} trials in {out}")

    with Stop() as stop:
        search_settings(
            config,
            searches,
            trials=run.trials,
            seeds=run.seeds,
            prune=run.prune,
            out=out,
            engine=engine,
            say=say,
            should_stop=stop,
        )
        again = args if run.out else [*args, "--out", str(out)]
        stop.exit_if_asked(f"{program()} sweep {shlex.join(again)}")
