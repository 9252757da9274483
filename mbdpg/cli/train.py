"""`mbdpg train`."""

from __future__ import annotations

import dataclasses
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mbdpg import envs
from mbdpg.cli.demonstrate import Demonstrate, make_demonstrations
from mbdpg.cli.flags import as_flags, default_folder, imports, program, run_flags
from mbdpg.experiments import presets, run
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import Algorithm, RunConfig
from mbdpg.experiments.stopping import Stop
from mbdpg.reports.comparison import grouped
from mbdpg.reports.console import RunDisplay
from mbdpg.reports.record import read_records
from mbdpg.storage.run_folder import RunFolder, require_unused
from mbdpg.training.randomness import checked_seeds


@dataclass(frozen=True)
class RunOptions:
    """What is run."""

    algorithm: Algorithm = "mbdpg"
    """Algorithm to train."""
    preset: presets.Preset = "default"
    """Settings that measured best here, or those published; any other flag changes a single one."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds; each is a run of its own, all in this process."""
    out: Path | None = None
    """Folder that gets one run folder per seed; by default runs/ENV-ALGORITHM-TIME."""
    demonstrations: str = "none"
    """File to begin from (see mbdpg demonstrate), `expert` to make one first, or `none`."""
    debug: bool = False
    """Show the traceback of an error."""


def train(args: list[str]) -> None:
    """Run the verb."""
    flags = run_flags("train", "Learn a policy for a Gymnasium environment.", RunOptions, args)
    checked_seeds(flags.run.seeds)  # before an expert is trained for them
    keep_compilations()
    config = RunConfig(envs.current_id(flags.env), flags.agent, flags.schedule, flags.env_options)
    out = flags.run.out or default_folder("runs", config)
    if flags.run.demonstrations == "expert":
        run.check_task(config)
        for seed in flags.run.seeds:
            require_unused(out / f"seed-{seed}")
        file = out / "demonstrations.safetensors"
        teacher = Demonstrate(flags.env, file, seed=flags.run.seeds[0], env_options=flags.env_options)
        again = [flags.env, "--out", str(file), "--seed", str(teacher.seed), *as_flags(flags.env_options)]
        make_demonstrations(teacher, again, then=f", then this again with --demonstrations {shlex.quote(str(file))}")
        config = dataclasses.replace(config, demonstrations=str(file))
    elif flags.run.demonstrations != "none":
        config = dataclasses.replace(config, demonstrations=flags.run.demonstrations)
    with Stop() as stop:
        with RunDisplay(config.schedule.steps) as display:
            runs = run.train(config, seeds=flags.run.seeds, out=out, on_update=display, should_stop=stop)
        stop.exit_if_asked(shlex.join([program(), "resume", str(out), *imports(config.env_options)]))
    finish(runs)


def finish(runs: Sequence[Path]) -> None:
    """Draw the learning curves of all runs that lie where these do, on the task of the first; say what to do next.

    Means are over the steps at which all runs of the same settings were evaluated.
    """
    from mbdpg.reports.curves import draw_curves  # not before: Matplotlib is a fifth of all modules' time

    first = runs[0]
    folder = first.parent if first.name not in ("", "..") else Path(os.path.abspath(first)).parent
    beside = sorted(config.parent for config in folder.glob("*/config.json"))
    records = read_records(beside, leave_out=lambda why: print(f"mbdpg: not drawn: {why}", file=sys.stderr))
    config = RunConfig.of(RunFolder.open(first))
    groups = {label: [run.folder for run in own] for label, own in grouped(records).get(config.env, {}).items()}
    draw_curves(groups, folder / "learning-curve.png", title=config.env)
    print(f"done: {folder}, learning curve in {folder / 'learning-curve.png'}")
    film = ["--episodes", "10", "--video", str(folder / "policy.mp4")]
    print("next:", shlex.join([program(), "evaluate", str(first), *film, *imports(config.env_options)]))
