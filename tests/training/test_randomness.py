"""Seeds are what they must be, and exploration noise has the color that it is asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mbdpg.interfaces import UserError
from mbdpg.training.randomness import checked_seeds, noise_block


def test_seeds_may_be_numpys_and_become_plain() -> None:
    """They ended in a TypeError of JSON's."""
    for given in (np.arange(3), (i for i in range(3)), (np.int64(0), 1, 2)):
        found = checked_seeds(given)
        assert found == [0, 1, 2] and {type(seed) for seed in found} == {int}


@pytest.mark.parametrize("seeds", [[0.5], ["0"], [None], [], [1, 1], [-1], [2**31]], ids=str)
def test_other_seeds_are_refused(seeds: list[Any]) -> None:
    """One of 0.5 began a run that nothing could go on with."""
    with pytest.raises(UserError, match="expected whole numbers from 0"):
        checked_seeds(seeds)


@pytest.mark.parametrize("color", [0.0, 1.0, 2.0])
def test_the_power_of_noise_falls_with_frequency_as_its_color_says(color: float) -> None:
    noise = np.stack([noise_block(3, block, 4, color) for block in range(100)])
    assert noise.shape == (100, 1024, 4)
    assert np.mean(noise**2) == pytest.approx(1.0, rel=0.1)
    np.testing.assert_allclose(noise.sum(axis=1), 0.0, atol=1e-9)
    assert np.abs(np.mean(noise[..., 0] * noise[..., 1])) < 0.05  # every action has its own
    power = np.mean(np.abs(np.fft.rfft(noise, axis=1)) ** 2, axis=(0, 2))
    slope = np.polyfit(np.log(np.arange(1, 512)), np.log(power[1:512]), 1)[0]
    assert slope == pytest.approx(-color, abs=0.05)
    assert power[512] / power[511] == pytest.approx(1.0, abs=0.25)  # which has no complex conjugate
