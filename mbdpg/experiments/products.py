"""The matrix products that a traced program takes, and the time that each takes by itself."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mbdpg.networks.mlp import matrix_product

CALLS = 5
"""Of what is timed."""


class Product(NamedTuple):
    """The shape of a matrix product: `batch` times (rows, inner) by (inner, columns)."""

    batch: int
    rows: int
    inner: int
    columns: int

    @property
    def gflop(self) -> float:
        """2 operations per multiplication and addition."""
        return 2e-9 * self.batch * self.rows * self.inner * self.columns


def matrix_products(program: Any) -> Counter[Product]:
    """Every matrix product that a traced program (a jaxpr) takes, loops counted as often as they go round."""
    found: Counter[Product] = Counter()
    for equation in program.eqns:
        if equation.primitive.name == "dot_general":
            left, right = (operand.aval.shape for operand in equation.invars)
            found[_product(left, right, equation.params["dimension_numbers"])] += 1
        inside = [matrix_products(inner) for inner in _programs(equation.params.values())]
        if equation.primitive.name == "cond":  # one of them is taken: count the dearest
            inside = [max(inside, key=lambda products: sum(p.gflop * n for p, n in products.items()))]
        rounds = equation.params["length"] if equation.primitive.name == "scan" else 1
        for products in inside:
            found += Counter({product: rounds * count for product, count in products.items()})
    return found


def _programs(parameters: Iterable[Any]) -> Iterable[Any]:
    for value in parameters:
        for item in value if isinstance(value, tuple | list) else (value,):
            item = getattr(item, "jaxpr", item)
            if hasattr(item, "eqns"):
                yield item


def _product(left: tuple[int, ...], right: tuple[int, ...], dimensions: Any) -> Product:
    (contracted, contracted_right), (batched, batched_right) = dimensions

    def size(shape: tuple[int, ...], axes: Iterable[int]) -> int:
        return math.prod(shape[axis] for axis in axes)

    rows = set(range(len(left))) - {*contracted, *batched}
    columns = set(range(len(right))) - {*contracted_right, *batched_right}
    return Product(size(left, batched), size(left, rows), size(left, contracted), size(right, columns))


def product_seconds(product: Product) -> float:
    """Time of one product, from a compiled loop over as many as take some milliseconds."""
    repeats = int(np.clip(0.5 / product.gflop, 2, 200))
    rng = np.random.default_rng(0)
    left = jnp.asarray(rng.normal(size=(repeats, product.batch, product.rows, product.inner)), jnp.float32)
    right = jnp.asarray(rng.normal(size=(product.batch, product.inner, product.columns)), jnp.float32)
    loop = jax.jit(lambda left, right: jax.lax.map(lambda x: matrix_product(x, right), left))
    return median_seconds(lambda: loop(left, right).block_until_ready()) / repeats


def median_seconds(call: Callable[[], Any]) -> float:
    """Median time of a call that returns when it is done; the first, which compiles, does not count."""
    call()
    seconds = []
    for _ in range(CALLS):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))
