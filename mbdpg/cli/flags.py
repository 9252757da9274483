"""From a verb's flags to a dataclass; wrong usage is one line."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

import tyro

from mbdpg.experiments import presets
from mbdpg.experiments.config import CONFIGS, EnvOptions, RunConfig
from mbdpg.interfaces import as_flag, one_line, require
from mbdpg.training.loop import Schedule

RunArgument = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
EnvArgument = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ENV")]


def parse(kind: type[Any], verb: str, args: Sequence[str]) -> Any:
    """Parse a verb's flags into `kind`, or explain what was wrong and exit with status 2."""
    stderr = io.StringIO()
    try:
        with contextlib.redirect_stderr(stderr):
            return tyro.cli(kind, prog=f"mbdpg {verb}", args=args, description=kind.__doc__)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        print(f"mbdpg {verb}: {_plain(stderr.getvalue())}", file=sys.stderr)
        sys.exit(2)


def peek(args: Sequence[str], flag: str, default: str) -> str:
    """A flag's value before the rest can be parsed, because the rest depends on it; of several, the last."""
    found = default
    for position, arg in enumerate(args):
        if arg == f"--{flag}" and position + 1 < len(args):
            found = args[position + 1]
        elif arg.startswith(f"--{flag}="):
            found = arg.split("=", 1)[1]
    return found


def program() -> str:
    """What to type for this program where it was started."""
    called = Path(sys.argv[0])
    return str(called) if called.name == "mbdpg" and not shutil.which("mbdpg") else "mbdpg"


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


def as_flags(settings: Any) -> list[str]:
    """What to type for those settings of a dataclass that are not the defaults."""
    values = {own.name: getattr(settings, own.name) for own in dataclasses.fields(settings)}
    defaults = {own.name: own.default for own in dataclasses.fields(settings)}
    return [word for name, value in values.items() if value != defaults[name] for word in as_flag(name, value)]


def imports(options: EnvOptions) -> list[str]:
    """The flag without which no command makes the environment of an id that names a module."""
    return ["--allow-import"] if options.allow_import else []


def _plain(text: str) -> str:
    """Tyro's boxed explanation as one line, without the box's title."""
    without_colors = re.sub(r"\x1b\[[0-9;]*m", "", text)
    return one_line(re.sub(r"╭[^╮]*╮|[╰╯│─]+|-{3,}", " ", without_colors))
