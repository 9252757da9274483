"""`mbdpg benchmark`."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

from mbdpg.cli.flags import parse
from mbdpg.experiments import benchmark as measuring
from mbdpg.interfaces import require
from mbdpg.storage.files import replace_durably


@dataclass(frozen=True)
class Benchmark:
    """Measure on this machine: updates at the paper's sizes, acting, starting, memory. A few minutes."""

    json: Path | None = None
    """File that gets all numbers."""
    quick: bool = False
    """Leave out how the time grows with horizon, batch, width and seeds."""
    debug: bool = False
    """Show the traceback of an error."""


def benchmark(args: list[str]) -> None:
    """Run the verb."""
    flags = parse(Benchmark, "benchmark", args)
    file = flags.json
    if file is not None:
        fits = os.access(file.absolute().parent, os.W_OK) and not file.is_dir()
        require(fits, f"--json is {file}, expected a file in a folder that can be written to")

    def show(what: str, value: str, remark: str) -> None:
        print(f"{what:<28} {value:>14}  {remark}".rstrip(), flush=True)

    measured = measuring.benchmark(show, growth=not flags.quick)
    if file is not None:
        replace_durably(file, json.dumps(measured, indent=2).encode())
        print(f"all numbers in {file}")
