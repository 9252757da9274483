"""`mbdpg benchmark`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from mbdpg.cli.flags import parse
from mbdpg.experiments import benchmark as measuring
from mbdpg.storage.files import replace_durably, require_place


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
        require_place(file, "--json")

    def show(what: str, value: str, remark: str) -> None:
        print(f"{what:<28} {value:>14}  {remark}".rstrip(), flush=True)

    measured = measuring.benchmark(show, growth=not flags.quick)
    if file is not None:
        replace_durably(file, json.dumps(measured, indent=2).encode())
        print(f"all numbers in {file}")
