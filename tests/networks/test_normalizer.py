"""Scaling of observations, and the bound that imagined states keep."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.networks.normalizer import BOUND, Normalizer, identity, soft_bound


@pytest.mark.parametrize("lead", [(), (4,), (2, 4)])
def test_observations_are_centred_and_scaled_at_every_rank(lead: tuple[int, ...]) -> None:
    mean, std = np.float32([1, -2, 3]), np.float32([0.5, 2, 4])
    x = np.random.default_rng(0).normal(size=(*lead, 3)).astype(np.float32)
    normalized = Normalizer(jnp.asarray(mean), jnp.asarray(std))(jnp.asarray(x))
    np.testing.assert_allclose(normalized, (x - mean) / std, rtol=1e-5)


def test_outliers_are_clipped() -> None:
    scale = Normalizer(jnp.zeros(3), jnp.full(3, 0.1))
    np.testing.assert_array_equal(scale(jnp.asarray([5.0, -5.0, 0.1])), np.float32([BOUND, -BOUND, 1]))


def test_the_identity_only_clips_or_not_even_that() -> None:
    x = jnp.asarray([0.0, -3.5, 99.0])
    np.testing.assert_array_equal(identity(3)(x), np.float32([0, -3.5, BOUND]))
    np.testing.assert_array_equal(identity(3, bounded=False)(x), x)


def test_soft_bound_is_the_identity_inside_to_the_last_bit() -> None:
    x = jnp.linspace(-BOUND, BOUND, 1001)
    np.testing.assert_array_equal(soft_bound(x), x)


def test_soft_bound_keeps_within_one_of_the_bound_and_in_order() -> None:
    x = jnp.asarray([-1e30, -20.0, -11.0, -10.5, 0.0, 10.5, 11.0, 20.0, 1e30])
    bounded = soft_bound(x)
    assert jnp.max(jnp.abs(bounded)) <= BOUND + 1
    assert (jnp.diff(bounded[1:-1]) > 0).all()


@pytest.mark.parametrize("x", [0.0, 9.999, 10.0, 10.001, -10.0, -12.0, 14.0, -14.0])
def test_soft_bound_passes_a_gradient_outside_too(x: float) -> None:
    slope = float(jax.grad(soft_bound)(jnp.float32(x)))
    assert slope == pytest.approx(1 - np.tanh(max(abs(x) - BOUND, 0.0)) ** 2, abs=1e-5)
    assert slope > 0
