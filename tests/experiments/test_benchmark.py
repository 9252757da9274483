"""The benchmark: it counts the matrix products that a program takes, and measures everything it promises."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.agents import mbdpg
from mbdpg.experiments import benchmark, products
from mbdpg.experiments.benchmark import Cost
from mbdpg.experiments.products import Product, matrix_products

TINY = mbdpg.Config(
    **{"horizon": 2, "batch_size": 4, "fit_batch_size": 4, "fit_length": 2, "burn_in": 1},
    **{"gaussians": 2, "width": 8, "memory": 8},
)


def counted(function: Any, *shapes: tuple[int, ...]) -> dict[Product, int]:
    return dict(matrix_products(jax.make_jaxpr(function)(*map(jnp.zeros, shapes)).jaxpr))


def test_a_product_has_two_operations_per_entry_and_inner_step() -> None:
    assert Product(2, 3, 5, 7).gflop == pytest.approx(2e-9 * 2 * 3 * 5 * 7)
    assert Cost(ms=2.0, gflop=0.1, attainable_gflops=100.0).share == pytest.approx(0.5)


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


def test_an_update_of_the_critics_and_actor_takes_no_weight_gradient_of_the_dynamics() -> None:
    learner = benchmark.made_up_learner(dataclasses.replace(TINY, memory=6))
    state = jax.tree.map(lambda x: x[0], learner.state)
    counts = {}
    for phase in learner.agent.phases[1:]:
        batch = jax.tree.map(lambda x: x[0], benchmark.made_up_batches(phase, 1))
        program = jax.make_jaxpr(lambda s, b, k, phase=phase: phase.update(s, b, key=k))(
            state, batch, jax.random.key(0)
        )
        products = matrix_products(program.jaxpr)
        # The LSTM has 17 + 6 + 6 inputs and 4 * 6 gates.
        counts[phase.name] = sum(n for p, n in products.items() if {p.rows, p.columns} == {29, 24})
    assert counts["improving"] == 0 < counts["fitting"]


@pytest.mark.parametrize("file", ["missing/numbers.json", "."])
def test_where_nothing_can_be_written_nothing_is_measured(file: str, tmp_path: Path) -> None:
    from mbdpg.cli import main

    with pytest.raises(SystemExit, match="--json is .*, expected a file in a folder that can be written to"):
        main(["benchmark", "--json", str(tmp_path / file)])


@pytest.mark.timeout(300)  # whole processes, a minute on a slow machine and three beside other work
def test_everything_is_measured_and_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from mbdpg.cli import main

    monkeypatch.setattr(benchmark, "PAPER_SIZES", TINY)
    monkeypatch.setattr(benchmark, "DEFAULTS", TINY)
    monkeypatch.setattr(benchmark, "GROWTH", {"seeds": (2,)})
    monkeypatch.setattr(products, "CALLS", 2)
    monkeypatch.setattr(benchmark, "REPLAY_ROWS", 3000)
    main(["benchmark", "--json", str(tmp_path / "numbers.json")])
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    for name in ("improve_ms", "improve_gflop", "fit_ms", "fit_gflop", "attainable_gflops", "policy_us"):
        assert numbers[name] > 0, name
    for name in ("improve", "fit", "ground"):
        rate = numbers[f"{name}_gflop"] / (numbers[f"{name}_ms"] * 1e-3)
        assert 0 < numbers[f"{name}_share"] < 1.5
        np.testing.assert_allclose(rate / numbers[f"{name}_attainable_gflops"], numbers[f"{name}_share"], rtol=1e-6)
    assert 0 < numbers["warm_start_s"] < numbers["cold_start_s"] and numbers["peak_memory_mb"] > 100
    assert numbers["growth_ms"]["seeds"]["improving"]["2"] > 0 and numbers["growth_ms"]["seeds"]["fitting"]["2"] > 0
    rows = capsys.readouterr().out.splitlines()
    for number, unit in (("improve_ms", "ms"), ("ground_ms", "ms"), ("cold_start_s", "s"), ("policy_us", "us")):
        assert any(f" {numbers[number]:.1f} {unit}  " in row for row in rows), number
    assert any(row.startswith("peak memory ") and "3,000 steps" in row for row in rows)
