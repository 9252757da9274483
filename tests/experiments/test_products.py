"""Matrix products that a program takes are counted by their shapes."""

from typing import Any

import jax
import jax.numpy as jnp
import pytest

from mbdpg.experiments.products import Product, matrix_products


def counted(function: Any, *shapes: tuple[int, ...]) -> dict[Product, int]:
    return dict(matrix_products(jax.make_jaxpr(function)(*map(jnp.zeros, shapes)).jaxpr))


def test_a_product_has_two_operations_per_entry_and_inner_step() -> None:
    assert Product(2, 3, 5, 7).gflop == pytest.approx(2e-9 * 2 * 3 * 5 * 7)


def test_products_are_counted_with_their_gradients_and_not_where_none_is_asked_for() -> None:
    def loss(x: jax.Array, weight: jax.Array) -> jax.Array:
        return jnp.sum(jnp.tanh(x @ weight))

    forward, by_weight = Product(1, 3, 5, 7), Product(1, 7, 3, 5)
    assert counted(loss, (3, 5), (5, 7)) == {forward: 1}
    assert counted(jax.grad(loss, argnums=1), (3, 5), (5, 7)) == {forward: 1, by_weight: 1}
    assert sum(counted(jax.grad(loss, argnums=(0, 1)), (3, 5), (5, 7)).values()) == 3


def test_loops_count_as_often_as_they_go_round_and_branches_once() -> None:
    def loop(x: jax.Array, weight: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda x, _: (jax.jit(jnp.matmul)(x, weight), None), x, None, length=6)[0]

    def branch(x: jax.Array, weight: jax.Array) -> jax.Array:
        return jax.lax.cond(x[0, 0] > 0, lambda: x @ weight @ weight, lambda: x @ weight)

    assert counted(loop, (3, 5), (5, 5)) == {Product(1, 3, 5, 5): 6}
    assert counted(branch, (3, 5), (5, 5)) == {Product(1, 3, 5, 5): 2}
    assert counted(jax.vmap(jnp.matmul), (4, 3, 5), (4, 5, 2)) == {Product(4, 3, 5, 2): 1}
