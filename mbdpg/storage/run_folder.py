"""The folder that a run leaves behind, and the right to write in it.

::

    RUN/config.json                 what was run, with which versions, on what machine; written first, never changed
        lock                        who writes here now
        metrics.jsonl timings.jsonl see metrics
        tensorboard/                the same for TensorBoard
        checkpoints/ replay/        see checkpoint
        policy/                     the exported policy
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
import shutil
import socket
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, final

from mbdpg.interfaces import UserError
from mbdpg.storage.files import TEMPORARY, DamagedFileError, parse_object, read_checked, sync_folder, write_durably

FORMAT = "mbdpg-run"
VERSION = 1
MAX_CONFIG_BYTES = 1 << 20

_CONFIG = "config.json"
_CONTENTS = (_CONFIG, "lock", "metrics.jsonl", "timings.jsonl", "tensorboard", "checkpoints", "replay", "policy")
_PACKAGES = ("mbdpg", "jax", "jaxlib", "numpy", "equinox", "optax", "gymnasium", "mujoco", "box2d")


@final
@dataclass(frozen=True)
class RunFolder:
    """A run on disk. Make one with `create` or `open`; nothing in it is ever unpickled, evaluated or imported."""

    path: Path
    config: dict[str, Any]
    """What `create` was given, as JSON gives it back (tuples are lists)."""

    @classmethod
    def create(cls, path: Path, config: Mapping[str, Any], *, undo: contextlib.ExitStack | None = None) -> RunFolder:
        """Make the folder and write `config` (JSON) in it; on failure nothing new is left behind.

        Nor when `undo` is closed: it deletes the folder, whatever is in it by then.

        Raises:
            UserError: `path` exists and is not an empty folder, or cannot be made or written.
            ValueError, TypeError: `config` is over 1 MiB, or not JSON.
        """
        data = json.dumps({"format": FORMAT, "version": VERSION, "run": config}, indent=2).encode()
        if len(data) > MAX_CONFIG_BYTES:
            raise ValueError(f"the config has {len(data)} bytes, more than the {MAX_CONFIG_BYTES} allowed")
        with contextlib.ExitStack() as made:
            try:
                for folder in reversed([path, *path.parents]):
                    if not folder.exists():
                        folder.mkdir(exist_ok=True)  # runs that start together may share it
                        made.callback(_forget, folder.rmdir)
                _claim(path, data, made)
            except OSError as error:
                raise _not_made(path, error) from error
            kept = made.pop_all()
        if undo is not None:
            undo.push(kept)
            undo.callback(shutil.rmtree, path, ignore_errors=True)
        return cls(path, json.loads(data)["run"])

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Open a folder that `create` made, perhaps on another machine, perhaps by somebody hostile.

        Raises:
            UserError: it is not there, not a run, damaged, of another version, or its parts are links.
        """
        name = path / _CONFIG
        try:
            if not path.is_dir():
                raise UserError(f"{path} is not a folder; expected one that `mbdpg train --out` made")
            content = parse_object(read_checked(name, limit=MAX_CONFIG_BYTES), name)
        except DamagedFileError as damage:
            runs = sorted(found.parent for found in path.glob(f"*/{_CONFIG}"))
            hint = f"; expected one of its runs, such as {runs[0]}" if runs else ""
            raise UserError(f"{path} is not a run folder: {damage}{hint}") from damage
        except OSError as error:
            raise UserError(f"cannot open {path}: {error.strerror}") from error
        if content.get("format") != FORMAT or not isinstance(content.get("run"), dict):
            raise UserError(f'{path} is not a run folder: {name} does not have "format": "{FORMAT}" and "run"')
        if content.get("version") != VERSION:
            version = str(content.get("version"))[:20]
            raise UserError(f"{name} has version {version!r}; this mbdpg reads version {VERSION}: use the other mbdpg")
        for part in _CONTENTS:
            # A run from a stranger must not make us truncate or delete files elsewhere.
            if (path / part).is_symlink():
                raise UserError(f"{path / part} is a link; a run folder holds its own files: copy the target there")
        return cls(path, content["run"])

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Be the only process that writes in this folder, until the `with` block or the process ends.

        The kernel holds the lock, so one that died, by whatever signal, leaves none behind.

        Raises:
            UserError: another process holds it (the text has its pid and host), or the folder cannot be locked.
        """
        with only_writer(self.path):
            yield


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Hold a folder's lock until the `with` block or the process ends, by whatever signal: the kernel gives it back.

    Raises:
        UserError: another process holds it, or the folder cannot be locked.
    """
    descriptor = _acquire(folder / "lock")
    try:
        yield
    finally:
        os.close(descriptor)


def require_unused(path: Path) -> None:
    """Refuse a run folder's place that is not free.

    Raises:
        UserError: it is there and not an empty folder that can be read.
    """
    try:
        content = next(path.iterdir(), None)
    except FileNotFoundError:
        return
    except OSError as error:
        raise _not_made(path, error) from error
    if content is not None:
        raise _used(path, content)


def discard_unbegun(path: Path) -> None:
    """Delete a run folder whose process died before its first checkpoint, when there was nothing to go on from.

    One that died before it had written the config, or while it deleted such a folder, has left an empty one.

    Raises:
        UserError: it is no run folder, a process works in it, or it holds something that mbdpg did not write.
    """
    if not path.is_dir() or not {entry.name for entry in path.iterdir()} <= {f"{TEMPORARY}{_CONFIG}", "lock"}:
        RunFolder.open(path)
    with only_writer(path):
        strange = [entry.name for entry in path.iterdir() if entry.name.removeprefix(TEMPORARY) not in _CONTENTS]
        strange += [entry.name for entry in (path / "checkpoints").glob("[0-9]*")]
        if strange:
            raise UserError(f"{path} has no checkpoint, but has {strange[0]!r}; move it away, or choose another --out")
        for part in _CONTENTS[::-1]:  # the config last: without it what is left would be nobody's
            if (path / part).is_dir():
                shutil.rmtree(path / part)
            else:
                (path / part).unlink(missing_ok=True)
        shutil.rmtree(path)


def describe_machine() -> dict[str, Any]:
    """What of the host decides whether a run repeats bit for bit: processor, cores to use, versions, XLA flags."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "versions": {package: _version(package) for package in _PACKAGES},
        "XLA_FLAGS": os.environ.get("XLA_FLAGS"),
    }


def _claim(path: Path, data: bytes, undo: contextlib.ExitStack) -> None:
    """Write the config into the empty folder `path`; of two processes that try at once, one succeeds at most."""
    temporary = path / f"{TEMPORARY}{_CONFIG}"
    require_unused(path)
    try:
        write_durably(temporary, data)
        undo.callback(_forget, temporary.unlink)
        # The other process may have begun and ended between the look and the write.
        occupied = next((other for other in path.iterdir() if other != temporary), None)
    except FileExistsError:
        occupied = temporary
    if occupied is not None:
        raise _used(path, occupied)
    os.replace(temporary, path / _CONFIG)
    undo.callback(_forget, (path / _CONFIG).unlink)
    sync_folder(path)
    sync_folder(path.parent)


def _not_made(path: Path, error: OSError) -> UserError:
    return UserError(f"cannot create {path}: {error.strerror}; choose another --out")


def _used(path: Path, content: Path) -> UserError:
    return UserError(f"{path} is not empty (it has {content.name!r}); resume it or choose another --out")


def _forget(remove: Callable[[], object]) -> None:
    """Call `remove` while another error is on its way, which must not be hidden by a second."""
    with contextlib.suppress(OSError):
        remove()


def _acquire(lock: Path) -> int:
    """Return the descriptor whose closing gives the lock back."""
    try:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    except OSError as error:
        raise UserError(f"cannot lock {lock}: {error.strerror}; make the folder writable") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"pid {os.getpid()} on host {socket.gethostname()}".encode())
    except BlockingIOError:
        holder = os.read(descriptor, 200).decode(errors="replace")
        os.close(descriptor)
        known = holder if holder and holder.isprintable() else "another process"
        raise UserError(f"{lock.parent} is in use by {known}; stop it or choose another --out") from None
    except OSError as error:
        os.close(descriptor)
        raise UserError(f"cannot lock {lock}: {error.strerror}; make room, or use a disk that has locks") from error
    return descriptor


def _cpu_model() -> str:
    """Return the processor's name; Linux keeps it in /proc, elsewhere Python may know it."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as lines:
        for line in lines:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
