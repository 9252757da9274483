"""`mbdpg train`."""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from mbdpg.cli.demonstrate import Demonstrate, make_demonstrations
from mbdpg.cli.flags import EnvArgument, parse, peek, program
from mbdpg.experiments import presets, run
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import CONFIGS, Algorithm, EnvOptions, RunConfig
from mbdpg.experiments.stopping import Stop
from mbdpg.interfaces import require
from mbdpg.reports.console import RunDisplay
from mbdpg.training.loop import Schedule


@dataclass(frozen=True)
class RunOptions:
    """What is run."""

    algorithm: Algorithm = "mbdpg"
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


def train(args: list[str]) -> None:
    """Run the verb."""
    flags = run_flags("train", "Learn a policy for a Gymnasium environment.", RunOptions, args)
    keep_compilations()
    config = RunConfig(flags.env, flags.agent, flags.schedule, flags.env_options)
    out = flags.run.out or default_folder("runs", config)
    if flags.run.demonstrations == "expert":
        file = out / "demonstrations.safetensors"
        make_demonstrations(Demonstrate(flags.env, file, seed=flags.run.seeds[0], env_options=flags.env_options))
        config = dataclasses.replace(config, demonstrations=str(file))
    elif flags.run.demonstrations != "none":
        config = dataclasses.replace(config, demonstrations=flags.run.demonstrations)
    with Stop() as stop:
        with RunDisplay(config.schedule.steps) as display:
            runs = run.train(config, seeds=flags.run.seeds, out=out, on_update=display, should_stop=stop)
        stop.exit_if_asked(f"{program()} resume {out}")
    finish(runs, config.algorithm, config.env)


def run_flags(verb: str, purpose: str, options: type[Any], args: list[str]) -> Any:
    """What a verb is told that trains, over a preset's settings: `env`, `run` (its options), and those of a RunConfig.

    The options have `algorithm` and `preset`, which decide what other flags there are and their defaults.
    """
    algorithm, preset = peek(args, "algorithm", "mbdpg"), peek(args, "preset", "default")
    schedule, env_options = presets.run_settings(preset)
    agent = presets.agent_config(algorithm, preset, args[0] if args else None)
    flat: Any = tyro.conf.OmitArgPrefixes
    known = set[str]().union(*map(_names, (options, Schedule, EnvOptions, type(agent))))
    for flag in (arg.partition("=")[0] for arg in args if arg.startswith("--")):
        name = flag[2:].replace("-", "_").removeprefix("no_")
        others = [other for other, kind in CONFIGS.items() if name in _names(kind)]
        wrong = f"{flag} is no setting of {algorithm}, but of {' and '.join(others)}"
        require(name in known or not others, f"{wrong}; see mbdpg {verb} --algorithm {algorithm} --help")

    def told(agent: Any) -> Any:
        command = dataclasses.make_dataclass(
            verb.capitalize(),
            [
                ("env", Annotated[EnvArgument, tyro.conf.arg(help="Gymnasium id, as in HalfCheetah-v5.")]),
                ("run", flat[options], field(default_factory=options)),
                ("schedule", flat[Schedule], field(default=schedule)),
                ("env_options", flat[EnvOptions], field(default=env_options)),
                ("agent", flat[type(agent)], field(default=agent)),
            ],
            frozen=True,
        )
        command.__doc__ = purpose
        return parse(command, verb, args)

    flags = told(agent)
    own = presets.agent_config(algorithm, preset, flags.env)
    return flags if own == agent else told(own)  # where the task's id stands elsewhere


def _names(kind: type[Any]) -> set[str]:
    """Of a dataclass's fields."""
    return {field.name for field in dataclasses.fields(kind)}


def default_folder(parent: str, config: RunConfig) -> Path:
    """PARENT/ENV-ALGORITHM-TIME."""
    name = re.sub(r"[^A-Za-z0-9.-]+", "-", config.env)
    return Path(parent) / f"{name}-{config.algorithm}-{time.strftime('%Y%m%d-%H%M%S')}"


def finish(runs: Sequence[Path], algorithm: str, env: str) -> None:
    """Draw the learning curve beside the run folders and say what to do next."""
    from mbdpg.reports.curves import draw_curves  # not before: Matplotlib is a fifth of all modules' time

    folder = runs[0].parent
    draw_curves({algorithm: runs}, folder / "learning-curve.png", title=env)
    print(f"done: {folder}, learning curve in {folder / 'learning-curve.png'}")
    print(f"next: {program()} evaluate {runs[0]} --episodes 10 --video {folder / 'policy.mp4'}")
