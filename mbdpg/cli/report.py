"""`mbdpg report`: runs side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mbdpg.cli.flags import parse
from mbdpg.interfaces import require
from mbdpg.reports.comparison import NO_COMMON_STEP, run_folders, table
from mbdpg.reports.contents import compared, contents
from mbdpg.reports.page import write_page
from mbdpg.reports.record import read_records
from mbdpg.storage.files import require_place


@dataclass(frozen=True)
class Report:
    """Compare runs: for each environment a table of what every algorithm and setting reached, and a page with more."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders, or folders that hold some."""
    at: int | None = None
    """Environment steps at which they are compared, without runs that were not evaluated there; by default the last at
    which all were."""
    out: Path | None = None
    """HTML file for curves, tables, diagnostics, settings and videos, which needs no network; by default none."""
    debug: bool = False
    """Show the traceback of an error."""


def report(args: list[str]) -> None:
    """Run the verb."""
    flags = parse(Report, "report", args)
    require(len(flags.runs) > 0, "no run was given; expected run folders, or a folder that holds some")
    if flags.out is not None:
        require_place(flags.out, "--out", suffix=".html")
    left_out: list[str] = []
    runs = read_records(run_folders(flags.runs), leave_out=left_out.append)
    for reason in left_out:
        print(_harmless(f"left out: {reason}"))
    require(len(runs) > 0, "no run is left to report")
    environments = compared(runs, at=flags.at)
    # Without a common step a page still has the curves.
    require(flags.out is not None or any(environment.rows for environment in environments), NO_COMMON_STEP)
    for environment in environments:
        print("\n".join(map(_harmless, (environment.name, *table(environment.rows), *environment.notes))))
    if flags.out is not None:
        write_page(flags.out, contents(environments, left_out))
        print(f"page with curves, settings and more: {flags.out}")


def _harmless(line: str) -> str:
    """A run may be a stranger's: nothing in it is to move the terminal's cursor."""
    return line if line.isprintable() else repr(line)[1:-1]
