"""Dense layers against NumPy, at every rank, and how they start."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.networks.mlp import MLP, Linear, NormalizedELU, elu


def shaken(module, rng: np.random.Generator):
    """The module with every parameter drawn anew, so that no bias is 0 and no scale 1."""
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(0.3, 1.0, x.shape), jnp.float32), module)


def numpy_mlp(mlp: MLP, x: np.ndarray) -> np.ndarray:
    x = x.astype(np.float64)
    for linear, norm in zip(mlp.hidden, mlp.norms, strict=True):
        x = x @ np.asarray(linear.weight, np.float64) + np.asarray(linear.bias)
        x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
        x = x * np.asarray(norm.scale) + np.asarray(norm.offset)
        x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
    return x @ np.asarray(mlp.output.weight, np.float64) + np.asarray(mlp.output.bias)


def test_elu_is_the_exponential_linear_unit() -> None:
    x = np.linspace(-6, 6, 101, dtype=np.float32)
    np.testing.assert_allclose(elu(jnp.asarray(x)), np.where(x > 0, x, np.expm1(x)), atol=1e-6)


@pytest.mark.parametrize(("x", "slope"), [(-200.0, 0.0), (-1.0, np.exp(-1)), (1e-3, 1.0), (200.0, 1.0), (1e30, 1.0)])
def test_elu_has_a_finite_slope_where_its_unused_branch_would_overflow(x: float, slope: float) -> None:
    assert jax.grad(lambda x: elu(x))(jnp.float32(x)) == pytest.approx(slope, abs=1e-6)


@pytest.mark.parametrize("lead", [(), (5,), (2, 5), (3, 1, 2)])
def test_a_network_is_the_same_function_at_every_rank(key: jax.Array, lead: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    mlp = shaken(MLP(3, (8, 6), 2, key=key), rng)
    x = rng.normal(size=(*lead, 3)).astype(np.float32)
    np.testing.assert_allclose(mlp(jnp.asarray(x)), numpy_mlp(mlp, x), rtol=2e-4, atol=2e-4)


def test_a_plain_network_has_relus_and_no_norms(key: jax.Array) -> None:
    rng = np.random.default_rng(0)
    mlp = shaken(MLP(3, (8, 6), 2, plain=True, key=key), rng)
    x = rng.normal(size=(5, 3)).astype(np.float32)
    expected = x
    for linear in mlp.hidden:
        expected = np.maximum(expected @ np.asarray(linear.weight) + np.asarray(linear.bias), 0)
    expected = expected @ np.asarray(mlp.output.weight) + np.asarray(mlp.output.bias)
    np.testing.assert_allclose(mlp(jnp.asarray(x)), expected, rtol=2e-4)
    assert not mlp.norms


def test_a_plain_network_starts_as_pytorch_s(key: jax.Array) -> None:
    mlp = MLP(400, (300, 100), 2, output_scale=0.0, plain=True, key=key)
    for linear in (*mlp.hidden, mlp.output):
        bound = 1 / np.sqrt(linear.weight.shape[0])
        assert 0.98 * bound < np.abs(linear.weight).max() <= bound and abs(linear.weight.mean()) < 0.1 * bound
        assert float(linear.weight.std()) == pytest.approx(bound / np.sqrt(3), rel=0.05)
        assert 0 < np.abs(linear.bias).max() <= bound and not np.array_equal(linear.bias, linear.weight[0])


def test_without_hidden_layers_a_network_is_affine(key: jax.Array) -> None:
    mlp = shaken(MLP(3, (), 2, key=key), np.random.default_rng(1))
    x = jnp.asarray([[1.0, -2.0, 0.5]])
    np.testing.assert_allclose(mlp(x), x @ mlp.output.weight + mlp.output.bias[None], rtol=1e-6)


def test_weights_start_with_the_spread_of_their_inputs_number(key: jax.Array) -> None:
    linear = Linear(400, 300, scale=0.5, key=key)
    assert float(jnp.std(linear.weight)) == pytest.approx(0.5 / 20, rel=0.02)
    assert not linear.bias.any()


def test_no_two_layers_start_alike(key: jax.Array) -> None:
    mlp = MLP(4, (4, 4), 4, key=key)
    weights = [np.asarray(layer.weight) for layer in (*mlp.hidden, mlp.output)]
    assert all(np.abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.9 for a, b in itertools.pairwise(weights))


def test_output_scale_zero_starts_as_the_constant_zero(key: jax.Array) -> None:
    assert not MLP(3, (8,), 2, output_scale=0.0, key=key)(jnp.ones((4, 3))).any()


def test_equal_features_give_the_elu_of_the_offset_with_a_finite_gradient() -> None:
    norm = shaken(NormalizedELU(4), np.random.default_rng(2))
    same = jnp.full((2, 4), 7.0)
    np.testing.assert_allclose(norm(same), np.broadcast_to(elu(norm.offset), (2, 4)), rtol=1e-6)
    assert jnp.isfinite(jax.grad(lambda x: jnp.sum(jnp.square(norm(x))))(same)).all()


@pytest.mark.parametrize("lead", [(), (5,), (2, 5)])
def test_normalization_and_elu_have_the_derivative_that_differentiating_them_gives(lead: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    norm = shaken(NormalizedELU(6), rng)
    x = jnp.asarray(rng.normal(1.0, 2.0, (*lead, 6)), jnp.float32)
    weights = jnp.asarray(rng.normal(size=x.shape), jnp.float32)

    def plain(norm: NormalizedELU, x: jax.Array) -> jax.Array:
        ones = (1,) * (x.ndim - 1) + (6,)
        normalized = jax.nn.standardize(x, axis=-1, epsilon=1e-5)
        return jnp.sum(weights * jax.nn.elu(normalized * norm.scale.reshape(ones) + norm.offset.reshape(ones)))

    def ours(norm: NormalizedELU, x: jax.Array) -> jax.Array:
        return jnp.sum(weights * norm(x))

    expected = jax.grad(plain, argnums=(0, 1))(norm, x)
    for mine, other in zip(
        jax.tree.leaves(jax.grad(ours, argnums=(0, 1))(norm, x)), jax.tree.leaves(expected), strict=True
    ):
        np.testing.assert_allclose(mine, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("widths", [(), (6,), (8, 4, 6)])
def test_slopes_are_the_derivatives_that_differentiating_gives(key: jax.Array, widths: tuple[int, ...]) -> None:
    rng = np.random.default_rng(5)
    mlp = jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.3, x.shape), jnp.float32), MLP(3, widths, 1, key=key))
    x, weights = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((7, 3), (7,)))

    def weighed(mlp: MLP, x: jax.Array) -> jax.Array:
        return jnp.sum(mlp(x)[:, 0] * weights)

    slopes = mlp.slopes(x)
    np.testing.assert_allclose(slopes.output, mlp(x)[:, 0], rtol=1e-6)
    by_parameter, by_input = jax.grad(weighed, argnums=(0, 1))(mlp, x)
    np.testing.assert_allclose(weights[:, None] * slopes.by_input, by_input, rtol=1e-4, atol=1e-5)
    found = mlp.weighted_gradient(slopes, weights)
    assert jax.tree.structure(found) == jax.tree.structure(mlp)
    for mine, other in zip(jax.tree.leaves(found), jax.tree.leaves(by_parameter), strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-4, atol=1e-5)


def test_the_gradient_reaches_every_parameter(key: jax.Array) -> None:
    mlp = MLP(3, (8, 8), 2, key=key)
    gradient = jax.grad(lambda m, x: jnp.sum(jnp.square(m(x))))(
        mlp, jnp.asarray(np.random.default_rng(3).normal(size=(5, 3)), jnp.float32)
    )
    assert all(leaf.any() for leaf in jax.tree.leaves(gradient))


def test_products_are_of_float32_forwards_and_backwards_and_not_of_what_a_gpu_takes_for_one(key: jax.Array) -> None:
    layer = Linear(3, 2, key=key)
    program = jax.make_jaxpr(jax.grad(lambda layer, x: jnp.sum(layer(x) ** 2), argnums=(0, 1)))(layer, jnp.ones((4, 3)))
    assert str(program).count("dot_general[") == 3 and str(program).count("HIGHEST") == 6
