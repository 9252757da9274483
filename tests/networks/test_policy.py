"""The policies, and that what acts (NumPy) is what was learned (JAX)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.networks.normalizer import Normalizer
from mbdpg.networks.policy import GaussianPolicy, NumpyPolicy, Policy, policy_arrays


def shaken(policy: Any) -> Any:
    """The policy with all parameters away from where they start."""
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(0.2, 0.7, x.shape), jnp.float32), policy)


def learned(key: jax.Array, widths: tuple[int, ...], *, plain: bool = False) -> tuple[Policy, Normalizer]:
    policy = shaken(Policy(3, 2, widths, plain=plain, key=key))
    return policy, Normalizer(jnp.asarray([1.0, -2.0, 0.0]), jnp.asarray([0.5, 3.0, 1.0]))


def gaussian(key: jax.Array, *, plain: bool = False) -> GaussianPolicy:
    return shaken(GaussianPolicy(3, 2, (8, 6), plain=plain, key=key))


def arrays(key: jax.Array) -> dict[str, np.ndarray]:
    return policy_arrays(*learned(key, (8, 6)))


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("widths", [(), (8,), (8, 6, 8)])
def test_the_numpy_policy_acts_as_the_jax_policy(key: jax.Array, widths: tuple[int, ...], plain: bool) -> None:
    policy, normalizer = learned(key, widths, plain=plain)
    acting = NumpyPolicy(policy_arrays(policy, normalizer))
    rng = np.random.default_rng(1)
    observations = (rng.normal(size=(50, 3)) * 10.0 ** rng.uniform(-2, 3, (50, 1))).astype(np.float32)
    expected = policy(normalizer(jnp.asarray(observations)))
    actions = np.stack([acting(observation) for observation in observations])
    assert actions.dtype == np.float32 and actions.shape == (50, 2)
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert (acting.observation_size, acting.action_size) == (3, 2)


def test_a_deterministic_policy_explores_by_adding_noise_within_the_bounds(key: jax.Array) -> None:
    acting, observation = NumpyPolicy(arrays(key)), np.float32([1, 2, 3])
    noise = np.array([0.01, 5.0])
    expected = np.clip(acting(observation) + noise, -1, 1)
    np.testing.assert_allclose(acting.explore(observation, noise), expected, rtol=1e-6)
    assert acting.explore(observation, noise).dtype == np.float32


@pytest.mark.parametrize("plain", [False, True])
def test_a_gaussian_policy_explores_with_its_own_spread_before_the_tanh(key: jax.Array, plain: bool) -> None:
    policy, (_, normalizer) = gaussian(key, plain=plain), learned(key, ())
    acting, rng = NumpyPolicy(policy_arrays(policy, normalizer)), np.random.default_rng(1)
    for observation, noise in zip(rng.normal(size=(20, 3)), rng.normal(size=(20, 2)), strict=True):
        seen = normalizer(jnp.asarray(observation, jnp.float32))
        features = policy.center.mlp.features(seen)
        log_std = np.clip(policy.spread(features), -20, 2)
        expected = np.tanh(policy.center.mlp.output(features) + np.exp(log_std) * noise)
        found = acting.explore(observation, noise)
        np.testing.assert_allclose(found, expected, atol=2e-5)
        assert found.dtype == np.float32
        np.testing.assert_allclose(acting(observation), policy.center(seen), atol=2e-5)


def test_a_gaussian_policy_s_log_density_is_numpys(key: jax.Array) -> None:
    policy = gaussian(key)
    observation = jnp.asarray(np.random.default_rng(3).normal(size=(50, 3)), jnp.float32)
    features = policy.center.mlp.features(observation)
    mean, log_std = (np.asarray(head(features), np.float64) for head in (policy.center.mlp.output, policy.spread))
    std = np.exp(np.clip(log_std, -20, 2))
    assert std.min() < 0.5 and std.max() > 2  # else its sign would not matter
    unbounded = mean + std * np.asarray(jax.random.normal(key, mean.shape))
    normal = -0.5 * ((unbounded - mean) / std) ** 2 - np.log(std * np.sqrt(2 * np.pi))
    with np.errstate(divide="ignore"):
        density = np.sum(normal - np.log(1 - np.tanh(unbounded) ** 2), axis=-1)
    actions, found = policy.sample(observation, key=key)
    np.testing.assert_allclose(actions, np.tanh(unbounded), atol=1e-5)
    exact = np.isfinite(density) & (np.abs(unbounded) < 8).all(axis=-1)
    assert exact.sum() > 25
    np.testing.assert_allclose(np.asarray(found)[exact], density[exact], rtol=1e-3, atol=1e-3)


def test_a_saturated_action_has_a_finite_log_density_and_gradient(key: jax.Array) -> None:
    policy = GaussianPolicy(3, 2, (8,), key=key)
    policy = eqx.tree_at(lambda p: p.center.mlp.output.bias, policy, jnp.asarray([40.0, -40.0]))
    action, log_density = policy.sample(jnp.ones((4, 3)), key=key)
    assert jnp.abs(action).max() == 1 and jnp.isfinite(log_density).all()
    gradient = jax.grad(lambda p: jnp.sum(p.sample(jnp.ones((4, 3)), key=key)[1]))(policy)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_acting_leaves_the_observation_and_the_parameters_as_they_were(key: jax.Array) -> None:
    given = arrays(key)
    acting, observation = NumpyPolicy(given), np.float32([1, 2, 3])
    first = acting(observation)
    np.testing.assert_array_equal(observation, np.float32([1, 2, 3]))
    np.testing.assert_array_equal(acting(observation), first)
    assert all(np.array_equal(acting.arrays[name], value) for name, value in given.items())


def test_actions_start_near_zero_and_stay_within_one(key: jax.Array) -> None:
    fresh = Policy(3, 2, (8, 8), key=key)
    observations = jnp.asarray(np.random.default_rng(2).normal(size=(100, 3)), jnp.float32)
    assert jnp.max(jnp.abs(fresh(observations))) < 0.1
    policy, _ = learned(key, (8, 8))
    assert jnp.max(jnp.abs(policy(observations * 1e3))) <= 1.0


def test_a_policys_arrays_are_named_float32_and_complete(key: jax.Array) -> None:
    given = arrays(key)
    layers = {f"hidden/{i}/{part}" for i in (0, 1) for part in ("weight", "bias", "scale", "offset")}
    assert set(given) == {"mean", "std", "bound", "output/weight", "output/bias"} | layers
    assert {value.dtype for value in given.values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize(
    "missing",
    ["mean", "std", "bound", "output/weight", "output/bias", "hidden/0/weight", "hidden/1/weight", "hidden/0/scale"],
)
def test_a_missing_array_is_refused(key: jax.Array, missing: str) -> None:
    given = arrays(key)
    del given[missing]
    with pytest.raises(ValueError, match="policy"):
        NumpyPolicy(given)


@pytest.mark.parametrize("missing", ["spread/weight", "spread/bias"])
def test_half_a_spread_is_refused(key: jax.Array, missing: str) -> None:
    given = policy_arrays(gaussian(key), learned(key, ())[1])
    del given[missing]
    with pytest.raises(ValueError, match="policy"):
        NumpyPolicy(given)


@pytest.mark.parametrize(("name", "shape"), [("weight", (6, 1)), ("weight", (8, 2)), ("bias", (1,)), ("bias", ())])
def test_a_spread_of_another_shape_than_the_output_is_refused(key: jax.Array, name: str, shape: tuple) -> None:
    given = policy_arrays(gaussian(key), learned(key, ())[1])
    with pytest.raises(ValueError, match="spread"):
        NumpyPolicy(given | {f"spread/{name}": np.ones(shape, np.float32)})


@pytest.mark.parametrize("name", ["mean", "std", "hidden/0/weight", "hidden/1/offset", "output/bias"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_array_that_is_not_finite_is_refused(key: jax.Array, name: str, value: float) -> None:
    given = arrays(key)
    given[name] = given[name].copy()
    given[name].flat[0] = value
    with pytest.raises(ValueError, match=f"{name} is not finite"):
        NumpyPolicy(given)


MISSHAPEN = {
    "mean of rank 2": ("mean", (1, 3)),
    "mean of another size": ("mean", (4,)),
    "std of another size": ("std", (1,)),
    "bound with an axis": ("bound", (1,)),
    "transposed layer": ("hidden/1/weight", (6, 8)),
    "layer of rank 1": ("hidden/0/weight", (3,)),
    "scale that would broadcast": ("hidden/0/scale", (1,)),
    "bias that would broadcast": ("hidden/1/bias", ()),
    "offset of rank 2": ("hidden/1/offset", (1, 6)),
    "output from another width": ("output/weight", (8, 2)),
    "output of rank 3": ("output/weight", (6, 2, 2)),
    "output bias that would broadcast": ("output/bias", (1,)),
}


@pytest.mark.parametrize(("name", "shape"), MISSHAPEN.values(), ids=MISSHAPEN.keys())
def test_a_misshapen_array_is_refused(key: jax.Array, name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="policy"):
        NumpyPolicy(arrays(key) | {name: np.ones(shape, np.float32)})


def test_an_output_without_an_action_axis_is_refused(key: jax.Array) -> None:
    with pytest.raises(ValueError, match="policy"):
        NumpyPolicy(arrays(key) | {"output/weight": np.ones(6, np.float32), "output/bias": np.ones((), np.float32)})


@pytest.mark.parametrize("std", [0.0, -1.0])
def test_a_standard_deviation_that_is_not_positive_is_refused(key: jax.Array, std: float) -> None:
    with pytest.raises(ValueError, match="policy"):
        NumpyPolicy(arrays(key) | {"std": np.float32([1, std, 1])})
