"""`mbdpg reproduce`: the paper's experiments."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mbdpg.cli.flags import parse, program
from mbdpg.cli.places import Places, engine_of, made, say
from mbdpg.experiments.reproduce import reproduce as reproduce_study
from mbdpg.experiments.stopping import Stop
from mbdpg.experiments.studies import ScaleName, StudyName
from mbdpg.training.randomness import checked_seeds


@dataclass(frozen=True)
class Reproduce:
    """Run what is missing of one of the paper's figures or tables, and draw it. Studies share their runs."""

    study: Annotated[tyro.conf.Positional[StudyName], tyro.conf.arg(metavar="STUDY")]
    """Figure or table: figure-4 to figure-9, table-1."""
    scale: ScaleName = "quick"
    """Minutes, hours on two cores, or the paper's 200,000 steps and five seeds."""
    out: Path | None = None
    """Folder of all studies of a scale; by default studies/SCALE."""
    seeds: tuple[int, ...] = ()
    """Random seeds, instead of the scale's."""
    places: tyro.conf.OmitArgPrefixes[Places] = field(default_factory=Places)
    debug: bool = False
    """Show the traceback of an error."""


def reproduce(args: list[str]) -> None:
    """Run the verb."""
    flags = parse(Reproduce, "reproduce", args)
    if flags.seeds:
        checked_seeds(flags.seeds)
    engine = engine_of(flags.places)
    out = made(flags.out or Path("studies") / flags.scale, "a folder of studies")
    with Stop() as stop:
        reproduce_study(flags.study, flags.scale, out, engine, seeds=flags.seeds, say=say, should_stop=stop)
        stop.exit_if_asked(f"{program()} reproduce {shlex.join(args)}")
