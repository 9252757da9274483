import json
from pathlib import Path

import numpy as np
import pytest

from mbdpg.storage.files import DamagedFileError
from mbdpg.storage.tensors import MAX_HEADER_BYTES, pack, unpack

PICKLE = b"cos\nsystem\n(S'touch somebody-ran-me'\ntR."  # unpickling this runs `touch`


def test_nan_payloads_infinities_and_signed_zeros_come_back() -> None:
    odd = np.array([0x7FF8000000000123, 0xFFF0000000000000, 0x8000000000000000, 1], np.uint64).view(np.float64)
    assert unpack(pack({"x": odd}), "test")["x"].tobytes() == odd.tobytes()


@pytest.mark.parametrize(
    "array",
    [np.zeros(2, ">f4"), np.zeros(2, np.complex128), np.zeros(2, object), np.array(["a"]), np.zeros(2, "M8[s]")],
    ids=lambda array: str(array.dtype),
)
def test_what_would_not_come_back_is_refused(array: np.ndarray) -> None:
    with pytest.raises(ValueError, match="dtype"):
        pack({"x": array})


def test_an_array_cannot_take_the_formats_own_name() -> None:
    with pytest.raises(ValueError, match="reserved"):
        pack({"__metadata__": np.zeros(1)})


def test_equal_arrays_give_equal_bytes_whatever_their_layout() -> None:
    array = np.arange(6.0).reshape(2, 3)
    assert pack({"a": array, "b": array}) == pack({"b": np.asfortranarray(array), "a": array[:]})


def test_a_library_that_loses_values_is_noticed_before_anything_is_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(np, "asarray", lambda array, order: array)  # safetensors#825 at work
    with pytest.raises(ValueError, match="did not give 'x' back"):
        pack({"x": np.arange(6.0).reshape(2, 3).T})


def test_an_array_beyond_the_limits_is_refused_when_saved_too() -> None:
    with pytest.raises(ValueError, match="10000"):
        pack({str(number): np.zeros(0) for number in range(10_001)})
    with pytest.raises(ValueError, match="GiB"):
        pack({"x": np.broadcast_to(np.zeros(1), (1 << 30,))})
    with pytest.raises(ValueError, match="256 bytes"):
        pack({"x" * 257: np.zeros(1)})


def header(text: bytes, length: int | None = None) -> bytes:
    return (len(text) if length is None else length).to_bytes(8, "little") + text


HOSTILE_TENSORS = {
    "nothing": b"",
    "pickle": PICKLE,
    "pickle behind a header": header(b"{}") + PICKLE,
    "huge header": header(b"{}", (1 << 64) - 1),
    "large header": header(b"{}" + b" " * MAX_HEADER_BYTES),
    "header longer than the file": header(b"{}", 3),
    "deep header": header(b"[" * 100_000),
    "header that is no object": header(b"[]"),
    "too many arrays": header(
        json.dumps({f"{i}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(10_001)}).encode()
    ),
    "unknown dtype": header(b'{"x":{"dtype":"BF16","shape":[1],"data_offsets":[0,2]}}') + b"\0\0",
    "shape that overflows": header(b'{"x":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,0]}}'),
    "array beyond the file": header(b'{"x":{"dtype":"F32","shape":[9],"data_offsets":[0,36]}}') + b"\0" * 35,
    "rank 99": header(b'{"x":{"dtype":"U8","shape":[' + b",".join([b"1"] * 99) + b'],"data_offsets":[0,1]}}') + b"\0",
}


@pytest.mark.parametrize("data", HOSTILE_TENSORS.values(), ids=HOSTILE_TENSORS.keys())
def test_hostile_bytes_run_nothing_and_are_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: bytes
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DamagedFileError, match="the-file") as caught:
        unpack(data, "the-file")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
