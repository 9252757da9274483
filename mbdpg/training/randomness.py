"""Randomness as a pure function of what it is for, so that no generator's state is ever stored."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np

from mbdpg.interfaces import UserError, require


def checked_seeds(seeds: Iterable[Any]) -> list[int]:
    """Seeds as plain integers.

    Raises:
        UserError: they are not whole numbers from 0 to 2^31 - 1, one or more and all different.
    """
    wanted = "expected whole numbers from 0 to 2^31 - 1, one or more and all different"
    try:
        found = [operator.index(seed) for seed in seeds]
    except TypeError as error:
        raise UserError(f"--seeds are {seeds}, {wanted}") from error
    fit = 0 < len(found) == len(set(found)) and all(0 <= seed < 2**31 for seed in found)
    require(fit, f"--seeds are {found}, {wanted}")
    return found


def random_stream(seed: int, role: str, counter: int) -> np.random.Generator:
    """The generator for the `counter`-th time that a seed's run does what `role` names."""
    return np.random.default_rng([seed, *role.encode(), counter])


NOISE_BLOCK = 1024
"""Environment steps over which exploration noise is correlated at most."""


@lru_cache(maxsize=64)
def noise_block(seed: int, block: int, size: int, color: float) -> np.ndarray:
    """Gaussian noise of unit variance whose power falls with frequency as 1/f^color, shape (NOISE_BLOCK, size).

    Timmer and Koenig 1995; for exploration Eberhard et al. 2023: 0 is white, 1 pink, 2 red. A block sums to zero, and
    the next one does not continue it.
    """
    frequencies = np.fft.rfftfreq(NOISE_BLOCK)[1:, None]
    amplitudes = frequencies ** (-color / 2)
    amplitudes[-1] /= np.sqrt(2)  # what is alone at its frequency, without a complex conjugate
    normal = random_stream(seed, "noise", block).standard_normal((2, *amplitudes.shape[:1], size))
    spectrum = np.concatenate([np.zeros((1, size)), amplitudes * (normal[0] + 1j * normal[1])])
    spectrum[-1] = 2 * spectrum[-1].real
    noise = np.fft.irfft(spectrum, NOISE_BLOCK, axis=0) * NOISE_BLOCK / np.sqrt(4 * np.sum(amplitudes**2))
    noise.flags.writeable = False  # it is cached
    return np.asarray(noise)
