"""XLA's compiled programs, kept between processes: what took half a minute the first time is read in a second."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import jax

from mbdpg.storage.run_folder import describe_machine

LEAST_SECONDS = 0.02
"""What compiles faster is not worth a file; what takes longer is read in a tenth of the time."""


def keep_compilations() -> None:
    """Keep them in the user's cache folder (XDG_CACHE_HOME, or ~/.cache), unless JAX was told where already.

    Compiled programs are code, and the only code that is ever read from a file. So every processor and version has a
    folder of its own, which nobody else may have made; where there can be none, everything is compiled anew.
    """
    config: Any = jax.config
    if config.jax_compilation_cache_dir is not None:
        return
    machine = hashlib.sha256(json.dumps(describe_machine(), sort_keys=True).encode()).hexdigest()
    with contextlib.suppress(OSError, RuntimeError):  # no such folder can be made; nobody knows a home
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = caches / "mbdpg" / machine[:16]
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.name == "posix" and (folder.is_symlink() or folder.stat().st_uid != os.getuid()):
            return
        config.update("jax_compilation_cache_dir", str(folder.resolve()))
        config.update("jax_persistent_cache_min_compile_time_secs", LEAST_SECONDS)
