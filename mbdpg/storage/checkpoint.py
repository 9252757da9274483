"""Everything a run needs to go on exactly where it was, saved so that a loadable checkpoint always remains.

::

    RUN/checkpoints/000120000/manifest.json             SHA-256 and size of every file, chunks included
                              state.safetensors         arrays
                              facts.json                everything that is not an array
                              replay_tail.safetensors   the rows that do not fill a chunk yet
    RUN/replay/000007-89ab….safetensors                 the others, see replay_chunks

A checkpoint is written in a folder beside and renamed into place after every byte is on the disk. One which replaces
another of the same step first renames that to `<step>.old`, which `load_checkpoint` reads too.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np

from mbdpg.interfaces import UserError
from mbdpg.storage.files import (
    MAX_FILE_BYTES,
    TEMPORARY,
    DamagedFileError,
    FileRecord,
    parse_object,
    read_checked,
    read_recorded,
    record_of,
    sync_folder,
    write_durably,
)
from mbdpg.storage.replay_chunks import ReplayChunks, read_replay, tail_of
from mbdpg.storage.tensors import pack, unpack

FORMAT = "mbdpg-checkpoint"
VERSION = 1
MAX_JSON_BYTES = 16 << 20

_STATE, _FACTS, _TAIL = _OWN_FILES = ("state.safetensors", "facts.json", "replay_tail.safetensors")
_FOLDER = re.compile(r"([0-9]{9,18})(\.old)?")


@dataclass(frozen=True)
class Checkpoint:
    """What `CheckpointWriter.save` was given, bit for bit; the arrays are fresh and writable."""

    env_steps: int
    arrays: dict[str, np.ndarray]
    facts: dict[str, Any]
    replay: dict[str, np.ndarray]
    """Columns with the same leading length."""


class _Manifest(NamedTuple):
    files: tuple[FileRecord, ...]
    """The checkpoint's own, in the order of _OWN_FILES."""
    chunks: tuple[FileRecord, ...]
    """Those of `replay/`, in the order of their rows."""


@final
class CheckpointWriter:
    """Saves checkpoints of one run, whose lock the caller holds.

    The replay may only grow between two saves of one writer: rows saved in a chunk are neither read nor compared
    again. To go back to an older checkpoint, make a new writer.
    """

    def __init__(self, folder: Path, *, keep: int = 2) -> None:
        """Write into the run folder `folder`, keeping the newest `keep` >= 1 checkpoints."""
        if keep < 1:
            raise ValueError(f"keep must be at least 1, not {keep}")
        self._folder = folder / "checkpoints"
        self._replay_folder = folder / "replay"
        self._chunks = ReplayChunks(self._replay_folder)
        self._keep = keep

    def save(
        self,
        *,
        env_steps: int,
        arrays: Mapping[str, np.ndarray],
        facts: Mapping[str, Any],
        replay: Mapping[str, np.ndarray],
    ) -> Path:
        """Save a checkpoint, then delete those beyond `keep` and any of a later step; return its folder.

        `arrays` may have any rank and layout. `facts` is JSON: floats, NaN and infinities come back exactly, tuples
        as lists. `replay` has columns of the same leading length; it is never copied whole.

        Raises:
            UserError: the disk is full or not writable; what was saved before is intact.
            ValueError, TypeError: something that would not come back exactly, or a replay that shrank.
        """
        if env_steps < 0:
            raise ValueError(f"env_steps is negative: {env_steps}")
        needed = self._chunks.missing_bytes(replay)
        contents = dict(zip(_OWN_FILES, (pack(arrays), _json_bytes(facts), pack(tail_of(replay))), strict=True))
        needed += sum(map(len, contents.values()))
        try:
            self._prepare()
            self._chunks.append(replay)
            path = self._publish(env_steps, contents)
        except OSError as error:
            raise UserError(self._explain(env_steps, needed, error)) from error
        try:
            self._prune(env_steps)
        except OSError as error:
            # The checkpoint is safe and the next save prunes again: no reason to stop a run.
            print(f"WARNING: old checkpoints in {self._folder} were not deleted: {error}", file=sys.stderr)
        return path

    def _prepare(self) -> None:
        """Make the folders, and delete what a killed run left half-written: it may be what fills the disk."""
        for folder in (self._folder, self._replay_folder):
            folder.mkdir(exist_ok=True)
            for path in folder.glob(f"{TEMPORARY}*"):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink()
        sync_folder(self._folder.parent)

    def _publish(self, env_steps: int, contents: Mapping[str, bytes]) -> Path:
        """Write the checkpoint's own folder beside, then rename it into place."""
        final_path = self._folder / f"{env_steps:09d}"
        temporary = final_path.with_name(TEMPORARY + final_path.name)
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "env_steps": env_steps,
            "files": [record_of(name, data)._asdict() for name, data in contents.items()],
            "chunks": [record._asdict() for record in self._chunks.records],
        }
        try:
            temporary.mkdir()
            for name, data in {**contents, "manifest.json": _json_bytes(manifest)}.items():
                write_durably(temporary / name, data)
            sync_folder(temporary)
            if final_path.exists():
                old = final_path.with_name(f"{final_path.name}.old")
                if old.exists():
                    _discard(old)
                os.rename(final_path, old)
            os.rename(temporary, final_path)
            sync_folder(self._folder)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        return final_path

    def _prune(self, env_steps: int) -> None:
        """Delete checkpoints beyond `keep`, then the chunks that none of the others names.

        Those of a later step belong to a history that this run has left (they were damaged, so it went on from an
        older one); counting them among the newest would delete good ones in their favour.
        """
        kept: dict[int, Path] = {}
        for steps, path in _newest_first(self._folder):
            if steps > env_steps or steps in kept or len(kept) == self._keep:
                _discard(path)
            else:
                kept[steps] = path
        named = {record.name for record in self._chunks.records}
        for steps, path in kept.items():
            try:
                named |= {record.name for record in _read_manifest(path, steps).chunks}
            except DamagedFileError:
                continue  # it cannot be loaded, with or without its chunks
        self._chunks.delete_others(named)

    def _explain(self, env_steps: int, needed: int, error: OSError) -> str:
        """Say in one line what failed, how many MB to make room for, and what is left."""
        last = next((steps for steps, _ in _newest_first(self._folder)), None)
        left = "no checkpoint was saved before" if last is None else f"the last checkpoint (step {last}) is intact"
        return (
            f"cannot save a checkpoint of step {env_steps} in {self._folder}: {error.strerror or error}; "
            f"{needed / 1e6:.1f} MB are needed; {left}; make room or make the folder writable, then resume"
        )


def load_checkpoint(folder: Path) -> Checkpoint:
    """Load the newest undamaged checkpoint of the run folder `folder`; one line on stderr for each damaged one.

    Every file's size and hash are checked before it is parsed. Nothing is unpickled, evaluated or imported.

    Raises:
        UserError: there is no checkpoint, or none that is whole.
    """
    damaged = 0
    try:
        candidates = _newest_first(folder / "checkpoints")
    except OSError as error:
        raise UserError(f"cannot look for checkpoints in {folder}: {error.strerror}") from error
    for steps, path in candidates:
        try:
            return _read(folder, path, steps)
        except DamagedFileError as damage:
            damaged += 1
            print(f"WARNING: skipping checkpoint {path.name}: {damage}", file=sys.stderr)
    found = f"all {damaged} are damaged (see above)" if damaged else "none was saved yet"
    raise UserError(f"no checkpoint to load in {folder / 'checkpoints'}: {found}; start a new run with another --out")


def _read(folder: Path, path: Path, env_steps: int) -> Checkpoint:
    manifest = _read_manifest(path, env_steps)
    limits = {_STATE: MAX_FILE_BYTES, _FACTS: MAX_JSON_BYTES, _TAIL: MAX_FILE_BYTES}
    contents = {record.name: read_recorded(path, record, limit=limits[record.name]) for record in manifest.files}
    tail = unpack(contents[_TAIL], path / _TAIL)
    return Checkpoint(
        env_steps=env_steps,
        arrays=unpack(contents[_STATE], path / _STATE),
        facts=parse_object(contents[_FACTS], path / _FACTS),
        replay=read_replay(folder / "replay", manifest.chunks, tail),
    )


def _read_manifest(path: Path, env_steps: int) -> _Manifest:
    """Read the manifest in `path`; it must be of this step and name the files that a checkpoint has, no others."""
    name = path / "manifest.json"
    manifest = parse_object(read_checked(name, limit=MAX_JSON_BYTES), name)
    header = [manifest.get(key) for key in ("format", "version", "env_steps")]
    if header != [FORMAT, VERSION, env_steps]:
        raise DamagedFileError(f"{name} says {str(header)[:120]} instead of {[FORMAT, VERSION, env_steps]}")
    files = _records(manifest, "files", name)
    found = tuple(record.name for record in files)
    if found != _OWN_FILES:
        raise DamagedFileError(f"{name} names the files {str(found)[:120]} instead of {_OWN_FILES}")
    return _Manifest(files, _records(manifest, "chunks", name))


def _records(manifest: Mapping[str, Any], key: str, name: Path) -> tuple[FileRecord, ...]:
    try:
        records = tuple(FileRecord(**raw) for raw in manifest[key])
    except (KeyError, TypeError) as error:
        raise DamagedFileError(f"{name} has a malformed list of {key}") from error
    for record in records:
        if (type(record.name), type(record.sha256), type(record.size)) != (str, str, int):
            raise DamagedFileError(f"{name} has a malformed list of {key}")
    return records


def _newest_first(folder: Path) -> list[tuple[int, Path]]:
    """Return (env_steps, path) of every checkpoint in `folder`, a replaced one after its replacement."""
    found = []
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _FOLDER.fullmatch(path.name)
        if match and path.is_dir() and not path.is_symlink():
            found.append((int(match[1]), match[2] is None, path))
    return [(steps, path) for steps, _, path in sorted(found, reverse=True)]


def _discard(path: Path) -> None:
    """Delete a checkpoint; killed on the way, it is no longer taken for one."""
    doomed = path.with_name(TEMPORARY + path.name)
    os.rename(path, doomed)
    shutil.rmtree(doomed)


def _json_bytes(value: Mapping[str, Any]) -> bytes:
    data = json.dumps(value).encode()
    if len(data) > MAX_JSON_BYTES:
        raise ValueError(f"{len(data)} bytes of JSON are more than the {MAX_JSON_BYTES} allowed")
    return data
