"""Named arrays to bytes and back in the safetensors format: exact, and safe to read from a stranger."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from mbdpg.storage.files import MAX_FILE_BYTES, DamagedFileError, parse_object

MAX_TENSORS = 10_000
MAX_NAME_BYTES = 256
MAX_HEADER_BYTES = 4 << 20
"""Holds MAX_TENSORS names of MAX_NAME_BYTES; the format itself would let a file ask for 100 MB."""

_INTEGERS = (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64)
_DTYPES = frozenset(map(np.dtype, (np.bool_, *_INTEGERS, np.float16, np.float32, np.float64, np.complex64)))
"""Those that both NumPy and safetensors know, in this machine's byte order."""


def pack(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Serialize arrays of any rank and memory layout; equal arrays give equal bytes.

    Raises:
        ValueError: a dtype (or byte order), a name or a size that would not come back exactly.
    """
    if len(arrays) > MAX_TENSORS:
        raise ValueError(f"{len(arrays)} arrays are more than the {MAX_TENSORS} that one file may hold")
    for name, array in arrays.items():
        if name == "__metadata__" or len(name.encode()) > MAX_NAME_BYTES:
            raise ValueError(f"{name[:80]!r} cannot name an array: it is reserved or over {MAX_NAME_BYTES} bytes")
        if array.dtype not in _DTYPES:
            raise ValueError(f"{name!r} has dtype {array.dtype}, which does not survive safetensors and NumPy")
    if sum(array.nbytes for array in arrays.values()) > MAX_FILE_BYTES - MAX_HEADER_BYTES - 8:
        raise ValueError(f"the arrays need more than the {MAX_FILE_BYTES >> 30} GiB that one file may hold")
    # safetensors 0.8.0 stores wrong values for arrays that are not C-contiguous (safetensors#825). Not
    # np.ascontiguousarray, which turns rank 0 into rank 1.
    data = safetensors.numpy.save({name: np.asarray(array, order="C") for name, array in arrays.items()})
    for name, back in unpack(data, "the bytes just packed").items():
        array = arrays[name]
        if back.dtype != array.dtype or back.shape != array.shape or back.tobytes() != array.tobytes():
            raise ValueError(f"safetensors did not give {name!r} back as it was")
    return data


def unpack(data: bytes, name: str | Path) -> dict[str, np.ndarray]:
    """Return writable arrays by name; `name` is what the error calls the source of `data`.

    Raises:
        DamagedFileError: not safetensors, or beyond the limits of this module. Nothing larger than `data` is allocated.
    """
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > min(MAX_HEADER_BYTES, len(data) - 8):
        raise DamagedFileError(f"{name} is not a safetensors file, or its header is over {MAX_HEADER_BYTES} bytes")
    header = parse_object(data[8 : 8 + length], f"the header of {name}")
    if len(header) > MAX_TENSORS:
        raise DamagedFileError(f"{name} claims {len(header)} arrays, more than the {MAX_TENSORS} allowed")
    try:
        return safetensors.numpy.load(data)
    except (safetensors.SafetensorError, KeyError, ValueError) as error:
        raise DamagedFileError(f"{name} is not a readable safetensors file ({type(error).__name__})") from error
