"""A replay on disk: files of CHUNK_ROWS rows, each written once and shared by all checkpoints of a run.

A chunk bears the hash of its content in its name. So two histories of a run (it was killed, then went on from an
older checkpoint) can never overwrite each other's rows, and a checkpoint costs only what is new.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import final

import numpy as np

from mbdpg.storage.files import (
    MAX_FILE_BYTES,
    DamagedFileError,
    FileRecord,
    read_recorded,
    record_of,
    replace_durably,
    sync_folder,
)
from mbdpg.storage.tensors import pack, unpack

CHUNK_ROWS = 8192

_NAME = re.compile(r"([0-9]{6,12})-[0-9a-f]{16}\.safetensors")


@final
class ReplayChunks:
    """The chunks of one growing replay in `folder`, as far as this process knows them to be on the disk.

    The replay may only grow: rows already in a known chunk are neither read nor compared again.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._columns: dict[str, tuple[np.dtype, tuple[int, ...]]] = {}
        self.records: list[FileRecord] = []
        """In the order of their rows."""

    def missing_bytes(self, replay: Mapping[str, np.ndarray]) -> int:
        """Return about how many bytes `append` would write.

        Raises:
            ValueError: `replay` is not the known one grown longer: fewer rows, or other columns.
        """
        rows, known = row_count(replay), len(self.records) * CHUNK_ROWS
        if rows < known:
            raise ValueError(f"the replay has {rows} rows but {known} were saved before; it may only grow")
        if known and _columns(replay) != self._columns:
            raise ValueError(f"the replay's columns changed from {self._columns} to {_columns(replay)}")
        return (rows - rows % CHUNK_ROWS - known) * _row_bytes(replay)

    def append(self, replay: Mapping[str, np.ndarray]) -> None:
        """Write the full chunks of `replay` that are not on the disk yet, one at a time.

        Raises:
            OSError: as the file system does; no chunk is then half-written.
        """
        self._columns = _columns(replay)
        for index, record in enumerate(self.records):
            if not (self._folder / record.name).exists():
                del self.records[index:]
                break
        for index in range(len(self.records), row_count(replay) // CHUNK_ROWS):
            rows = slice(index * CHUNK_ROWS, (index + 1) * CHUNK_ROWS)
            data = pack({name: column[rows] for name, column in replay.items()})
            digest = record_of("", data).sha256
            record = FileRecord(f"{index:06d}-{digest[:16]}.safetensors", digest, len(data))
            try:
                read_recorded(self._folder, record)
            except DamagedFileError:  # most often: not there yet
                replace_durably(self._folder / record.name, data)
            self.records.append(record)
        sync_folder(self._folder)

    def delete_others(self, names: Set[str]) -> None:
        """Delete the chunks that are not in `names`.

        Raises:
            OSError: as the file system does.
        """
        for path in self._folder.iterdir():
            if _NAME.fullmatch(path.name) and path.name not in names:
                path.unlink()


def tail_of(replay: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return views of the last rows, those that do not fill a chunk (perhaps none)."""
    start = row_count(replay) // CHUNK_ROWS * CHUNK_ROWS
    return {name: column[start:] for name, column in replay.items()}


def read_replay(folder: Path, records: Sequence[FileRecord], tail: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Join the chunks in `folder` and the tail; at most one chunk is in memory besides the result.

    Raises:
        DamagedFileError: a chunk is not the recorded one, or chunks and tail do not belong together.
    """
    try:
        start = len(records) * CHUNK_ROWS
        rows = start + row_count(tail)
    except ValueError as error:
        raise DamagedFileError(f"the replay's tail beside {folder} is malformed: {error}") from error
    for index, record in enumerate(records):
        _check_claims(folder, index, record, CHUNK_ROWS * _row_bytes(tail))
    replay = {name: np.empty((rows, *column.shape[1:]), column.dtype) for name, column in tail.items()}
    for index, record in enumerate(records):
        part = unpack(read_recorded(folder, record), folder / record.name)
        if _columns(part) != _columns(tail) or any(len(column) != CHUNK_ROWS for column in part.values()):
            raise DamagedFileError(f"{folder / record.name} does not hold {CHUNK_ROWS} rows of the replay's columns")
        for name, column in part.items():
            replay[name][index * CHUNK_ROWS : (index + 1) * CHUNK_ROWS] = column
    for name, column in tail.items():
        replay[name][start:] = column
    return replay


def row_count(columns: Mapping[str, np.ndarray]) -> int:
    """Return the common leading length of the columns; 0 if there are none.

    Raises:
        ValueError: they differ, or one has rank 0.
    """
    lengths = {column.shape[:1] for column in columns.values()} or {(0,)}
    if len(lengths) > 1 or () in lengths:
        raise ValueError(f"columns of different length: { {name: c.shape for name, c in columns.items()} }")
    return int(lengths.pop()[0])


def _check_claims(folder: Path, index: int, record: FileRecord, least: int) -> None:
    """Check name and size before memory is allocated: a few bytes of tail can claim rows of any width."""
    match = _NAME.fullmatch(record.name)
    if match is None or int(match[1]) != index:
        raise DamagedFileError(f"chunk {index} of the replay has the forbidden name {record.name[:80]!r}")
    path = folder / record.name
    try:
        size = path.lstat().st_size
    except OSError as error:
        raise DamagedFileError(f"{path} is missing or cannot be read ({error.strerror})") from error
    if size != record.size or not least <= size <= MAX_FILE_BYTES:
        raise DamagedFileError(f"{path} has {size} bytes instead of {record.size} (at least {least} for its rows)")


def _columns(columns: Mapping[str, np.ndarray]) -> dict[str, tuple[np.dtype, tuple[int, ...]]]:
    return {name: (column.dtype, column.shape[1:]) for name, column in columns.items()}


def _row_bytes(columns: Mapping[str, np.ndarray]) -> int:
    return sum(column.dtype.itemsize * math.prod(column.shape[1:]) for column in columns.values())
