"""`mbdpg report`: runs side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mbdpg.cli.flags import parse
from mbdpg.interfaces import UserError, require
from mbdpg.reports.comparison import grouped, run_folders, table
from mbdpg.reports.curves import draw_curves


@dataclass(frozen=True)
class Report:
    """Compare runs: for each environment a table of what every algorithm and setting reached, and a picture."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders, or folders that hold some."""
    at: int | None = None
    """Environment steps at which they are compared; by default the last at which all were evaluated."""
    out: Path | None = None
    """Folder for a picture of the learning curves per environment; by default none is drawn."""
    debug: bool = False
    """Show the traceback of an error."""


def report(args: list[str]) -> None:
    """Run the verb."""
    flags = parse(Report, "report", args)
    require(len(flags.runs) > 0, "no run was given; expected run folders, or a folder that holds some")
    if flags.out is not None:
        try:
            flags.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"--out is {flags.out}, which cannot be a folder: {error.strerror}") from error
    for env, groups in grouped(run_folders(flags.runs)).items():
        print(env, *table(groups, at=flags.at), sep="\n")
        if flags.out is not None:
            picture = flags.out / f"{env.replace('/', '-').replace(':', '-')}.png"
            draw_curves(groups, picture, title=env)
            print(f"  learning curves in {picture}")
