"""One file of named arrays with JSON facts beside them: policies and demonstrations."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mbdpg.interfaces import UserError
from mbdpg.storage.files import (
    MAX_FILE_BYTES,
    DamagedFileError,
    parse_object,
    read_checked,
    replace_durably,
)
from mbdpg.storage.tensors import pack, unpack

_FACTS = "facts.json"


def write_array_file(path: Path, kind: str, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
    """Write or replace `path`, a safetensors file in which the facts are an array of UTF-8 bytes.

    Args:
        path: the file.
        kind: what it is, checked on reading.
        arrays: by name.
        facts: JSON.

    Raises:
        UserError: it cannot be written.
    """
    header = {"format": f"mbdpg-{kind}", "version": 1, "facts": facts, "sha256": _digest(arrays, facts)}
    text = json.dumps(header).encode()
    data = pack({**arrays, _FACTS: np.frombuffer(text, np.uint8)})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_durably(path, data)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}; choose another place or make room") from error


def read_array_file(path: Path, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what `write_array_file` wrote, perhaps by a stranger: nothing in it is unpickled, evaluated or imported.

    Returns:
        The arrays and the facts.

    Raises:
        UserError: missing, damaged, or of another kind.
    """
    try:
        arrays = unpack(read_checked(path, limit=MAX_FILE_BYTES), path)
        if _FACTS not in arrays:
            raise DamagedFileError(f"{path} was not written by mbdpg")
        header = parse_object(arrays.pop(_FACTS).tobytes(), path)
    except DamagedFileError as damage:
        raise UserError(f"{damage}; expected an mbdpg {kind} file") from damage
    if (header.get("format"), header.get("version")) != (f"mbdpg-{kind}", 1) or not isinstance(
        header.get("facts"), dict
    ):
        raise UserError(f"{path} is {str(header.get('format'))[:40]!r}, expected an mbdpg {kind} file of version 1")
    if header.get("sha256") != _digest(arrays, header["facts"]):
        raise UserError(f"{path} has other bytes than it was written with; expected an undamaged mbdpg {kind} file")
    return arrays, header["facts"]


def _digest(arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> str:
    """SHA-256 of arrays and facts, in hexadecimal."""
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype} {arrays[name].shape} ".encode())
        digest.update(array.data)
    return digest.hexdigest()
