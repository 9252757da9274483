"""Policies and demonstrations as files: what was written comes back, and what was changed is refused."""

from pathlib import Path

import numpy as np
import pytest

from mbdpg.interfaces import UserError
from mbdpg.storage.array_file import _digest, read_array_file, write_array_file

ARRAYS = {"b/weight": np.arange(6, dtype=np.float32).reshape(2, 3), "a": np.float32(2.5).reshape(())}
FACTS = {"env_steps": 7, "return_mean": -1.25}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_array_file(tmp_path / "made" / "x.safetensors", "policy", ARRAYS, FACTS)
    return tmp_path / "made" / "x.safetensors"


def test_what_was_written_comes_back(file: Path) -> None:
    arrays, facts = read_array_file(file, "policy")
    assert facts == FACTS and arrays.keys() == ARRAYS.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, ARRAYS[name], strict=True)


def test_a_flipped_bit_anywhere_in_the_numbers_or_facts_is_noticed(file: Path) -> None:
    data = file.read_bytes()
    for place in (data.rindex(ARRAYS["b/weight"].tobytes()) + 5, data.rindex(b"-1.25") + 1):
        damaged = bytearray(data)
        damaged[place] ^= 1
        file.write_bytes(damaged)
        with pytest.raises(UserError, match="x.safetensors has other bytes than it was written with"):
            read_array_file(file, "policy")


def test_arrays_that_changed_their_names_or_shapes_are_noticed() -> None:
    whole, weight = _digest(ARRAYS, FACTS), ARRAYS["b/weight"]
    for changed in (weight.reshape(3, 2), weight.view(np.int32)):
        assert _digest(ARRAYS | {"b/weight": changed}, FACTS) != whole
    assert _digest({"b/bias": weight, "a": ARRAYS["a"]}, FACTS) != whole


def test_another_kind_of_file_is_named(file: Path) -> None:
    with pytest.raises(UserError, match="is 'mbdpg-policy', expected an mbdpg demonstrations file"):
        read_array_file(file, "demonstrations")
