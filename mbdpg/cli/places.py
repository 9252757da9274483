"""What verbs that run many things share: where they are run, and how they say what happens."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mbdpg.experiments.cluster import Ray
from mbdpg.experiments.launch import Engine
from mbdpg.experiments.pool import Local
from mbdpg.interfaces import UserError, require


@dataclass(frozen=True)
class Places:
    """This machine, or a Ray cluster."""

    engine: Literal["local", "ray"] = "local"
    """Where runs are made: on this machine, or on a Ray cluster."""
    workers: int | None = None
    """Runs at once on this machine, by default one per core; each has its share of the cores."""
    address: str | None = None
    """Of a Ray cluster whose nodes share the file system, as in 10.0.0.1:6379; by default one is begun here."""
    gpus: bool = False
    """With Ray: a GPU for every piece of work, which trains all its seeds at once."""


def made(out: Path, what: str) -> Path:
    """The folder itself, as an absolute path.

    Raises:
        UserError: it cannot be one.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be {what} ({error.strerror}); choose another --out") from error
    return out.absolute()


def say(line: str) -> None:
    """Print a line of progress at once, whoever reads."""
    print(line, flush=True)


def engine_of(places: Places) -> Engine:
    """What the flags say.

    Raises:
        UserError: they contradict each other.
    """
    ray = places.engine == "ray"
    require(ray or (places.address is None and not places.gpus), "--address, --gpus need --engine ray")
    require(not ray or places.workers is None, "--workers is for this machine alone, not for --engine ray")
    if ray:
        return Ray(places.address, places.gpus)
    return Local() if places.workers is None else Local(places.workers)
