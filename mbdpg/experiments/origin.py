"""Where something comes from: the code and the machine that made it."""

from __future__ import annotations

import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import jax

from mbdpg.storage.run_folder import describe_machine
from mbdpg.training.learner import seed_mesh


def origin(seeds: int = 1) -> dict[str, Any]:
    """Commit and machine (JSON), as the config of runs of so many seeds and the note beside a file record them."""
    return {"commit": _commit(), "machine": machine(seeds)}


def machine(seeds: int = 1) -> dict[str, Any]:
    """What decides whether runs repeat bit for bit: the host, and the devices that share their seeds (JSON)."""
    kinds = Counter(device.device_kind for device in seed_mesh(seeds, jax.local_devices()).devices.flat)
    return describe_machine() | {"devices": ", ".join(f"{count} × {kind}" for kind, count in sorted(kinds.items()))}


def _commit() -> str | None:
    """The commit of the checkout this package runs from, with a + if it has changes; None elsewhere.

    Elsewhere is also where it is installed within another repository, whose commit says nothing of it.
    """

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        command = ["git", "-C", str(Path(__file__).parent), *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=5)

    try:
        tracked = git("ls-files", "--error-unmatch", Path(__file__).name)
        commit, changes = git("rev-parse", "HEAD"), git("status", "--porcelain", "-uno")
    except (OSError, subprocess.TimeoutExpired):
        return None
    known = tracked.returncode == commit.returncode == 0
    return commit.stdout.strip() + ("+" if changes.stdout.strip() else "") if known else None
