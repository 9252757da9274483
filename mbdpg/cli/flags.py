"""From a verb's flags to a dataclass; wrong usage is one line."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from mbdpg.interfaces import one_line

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


def _plain(text: str) -> str:
    """Tyro's boxed explanation as one line, without the box's title."""
    without_colors = re.sub(r"\x1b\[[0-9;]*m", "", text)
    return one_line(re.sub(r"╭[^╮]*╮|[╰╯│─]+|-{3,}", " ", without_colors))
