"""Files that survive a power cut when written, and that are not believed until checked when read."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import os
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mbdpg.interfaces import UserError, require

TEMPORARY = ".tmp-"
"""Prefix of everything half-written; whatever bears it after a crash may be deleted."""


MAX_FILE_BYTES = 4 << 30
"""Largest file that is read or written whole."""


class FileRecord(NamedTuple):
    """What a manifest says of one file."""

    name: str
    """Without a folder."""
    sha256: str
    size: int
    """Bytes."""


class DamagedFileError(Exception):
    """A file is not what was written, or not what it claims to be; the text names it and says what is wrong."""


def write_durably(path: Path, data: bytes) -> None:
    """Write a new file and return once its content is on the disk.

    Its name is only certain to be there after `sync_folder` of the parent.

    Raises:
        FileExistsError: `path` exists; it is left alone.
        OSError: as `open`, `write` and `fsync` do; no file is then left behind.
    """
    with open(path, "xb") as file:
        try:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        except BaseException:
            _forget(path)
            raise


def replace_durably(path: Path, data: bytes) -> None:
    """Write `path` beside and rename it into place, so that nobody ever sees half of it.

    Raises:
        OSError: as `write_durably`; `path` is then as it was.
    """
    temporary = path.with_name(TEMPORARY + path.name)
    temporary.unlink(missing_ok=True)  # of a process that was killed here
    write_durably(temporary, data)
    try:
        os.replace(temporary, path)
    except BaseException:
        _forget(temporary)
        raise


def replace_table(path: Path, rows: Iterable[Sequence[Any]]) -> None:
    """Write rows as CSV, as `replace_durably` does."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    replace_durably(path, text.getvalue().encode())


def require_place(path: Path, flag: str, *, suffix: str = "") -> None:
    """Look that a file can be written there, so that nobody waits for its content and then gets none.

    The folder that it is to lie in is made.

    Args:
        path: where it is to be.
        flag: that says so.
        suffix: what its name must end in.

    Raises:
        UserError: it has another ending, it is a folder, or it cannot be written.
    """
    require(not suffix or path.suffix == suffix, f"{flag} is {path}, expected a name that ends in {suffix}")
    require(not os.path.isdir(path), f"{flag} is {path}, a folder; expected a file's name")
    probe = path.with_name(TEMPORARY + path.name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        probe.unlink(missing_ok=True)  # one that a crash left behind
        write_durably(probe, b"")
        probe.unlink()
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}; choose another {flag}") from error


def sync_folder(path: Path) -> None:
    """Return once the names in folder `path` (creations, renames, deletions) are on the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_checked(path: Path, *, limit: int) -> bytes:
    """Return the content of a regular file of at most `limit` bytes.

    Raises:
        DamagedFileError: missing, unreadable, a link or a device, or too large.
    """
    try:
        # NOFOLLOW: a link could point outside the run; NONBLOCK: opening a named pipe would otherwise wait for ever.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise DamagedFileError(f"{path} is not a regular file")
            if found.st_size > limit:
                raise DamagedFileError(f"{path} has {found.st_size} bytes, more than the {limit} allowed")
            return file.read(found.st_size)  # not `limit`: read allocates what it is asked for
    except FileNotFoundError:
        raise DamagedFileError(f"{path} is missing") from None
    except OSError as error:
        reason = "is a link" if path.is_symlink() else f"cannot be read ({error.strerror})"
        raise DamagedFileError(f"{path} {reason}") from error


def record_of(name: str, data: bytes) -> FileRecord:
    """Return what to note about a file called `name` with content `data`."""
    return FileRecord(name, hashlib.sha256(data).hexdigest(), len(data))


def read_recorded(folder: Path, record: FileRecord, *, limit: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a file in `folder` if it is byte for byte the one that was recorded.

    Raises:
        DamagedFileError: as `read_checked`, or its size or hash differs.
    """
    path = folder / record.name
    data = read_checked(path, limit=limit)
    if len(data) != record.size:
        raise DamagedFileError(f"{path} has {len(data)} bytes instead of {record.size}")
    if hashlib.sha256(data).hexdigest() != record.sha256:
        raise DamagedFileError(f"{path} has changed since it was written (its SHA-256 differs)")
    return data


def parse_object(data: bytes, name: str | Path) -> dict[str, Any]:
    """Parse UTF-8 JSON whose top level is an object; `name` is what the error calls it.

    Raises:
        DamagedFileError: not JSON, not an object, or nested too deeply.
    """
    try:
        value = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(f"{name} is not valid JSON ({type(error).__name__})") from error
    if not isinstance(value, dict):
        raise DamagedFileError(f"{name} is not a JSON object")
    return value


def _forget(path: Path) -> None:
    """Delete a file while an error is on its way, which a second must not hide."""
    with contextlib.suppress(OSError):
        path.unlink()
