"""Where something comes from: the code and the machine that made it."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

from mbdpg.storage.run_folder import describe_machine


def origin() -> dict[str, Any]:
    """Commit and machine of this process (JSON), as a run's config and the note beside a file record them."""
    return {"commit": _commit(), "machine": describe_machine()}


def _commit() -> str | None:
    """The commit of the checkout this package runs from, with a + if it has changes; None elsewhere."""
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5)
        changes = subprocess.run([*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, timeout=5)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return commit.stdout.strip() + ("+" if changes.stdout.strip() else "") if commit.returncode == 0 else None
