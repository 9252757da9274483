"""The policy, and that what acts (NumPy) is what was learned (JAX)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.networks.normalizer import Normalizer
from mbdpg.networks.policy import NumpyPolicy, Policy, policy_arrays


def learned(key: jax.Array, widths: tuple[int, ...]) -> tuple[Policy, Normalizer]:
    """A policy with all parameters away from where they start."""
    rng = np.random.default_rng(0)
    policy = jax.tree.map(
        lambda x: jnp.asarray(rng.normal(0.2, 0.7, x.shape), jnp.float32), Policy(3, 2, widths, key=key)
    )
    return policy, Normalizer(jnp.asarray([1.0, -2.0, 0.0]), jnp.asarray([0.5, 3.0, 1.0]))


def arrays(key: jax.Array) -> dict[str, np.ndarray]:
    return policy_arrays(*learned(key, (8, 6)))


@pytest.mark.parametrize("widths", [(), (8,), (8, 6, 8)])
def test_the_numpy_policy_acts_as_the_jax_policy(key: jax.Array, widths: tuple[int, ...]) -> None:
    policy, normalizer = learned(key, widths)
    acting = NumpyPolicy(policy_arrays(policy, normalizer))
    rng = np.random.default_rng(1)
    observations = (rng.normal(size=(50, 3)) * 10.0 ** rng.uniform(-2, 3, (50, 1))).astype(np.float32)
    expected = policy(normalizer(jnp.asarray(observations)))
    actions = np.stack([acting(observation) for observation in observations])
    assert actions.dtype == np.float32 and actions.shape == (50, 2)
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert (acting.observation_size, acting.action_size) == (3, 2)


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
    assert set(given) == {"mean", "std", "output/weight", "output/bias"} | layers
    assert {value.dtype for value in given.values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize(
    "missing", ["mean", "std", "output/weight", "output/bias", "hidden/0/weight", "hidden/1/weight", "hidden/0/scale"]
)
def test_a_missing_array_is_refused(key: jax.Array, missing: str) -> None:
    given = arrays(key)
    del given[missing]
    with pytest.raises(ValueError, match="policy"):
        NumpyPolicy(given)


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
