"""The benchmark: it counts the matrix products that a program takes, and measures everything it promises."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from mbdpg.agents import mbdpg
from mbdpg.experiments import benchmark, products
from mbdpg.experiments.benchmark import Cost
from mbdpg.experiments.products import matrix_products

TINY = mbdpg.Config(
    **{"horizon": 2, "batch_size": 4, "fit_batch_size": 4, "fit_length": 2, "burn_in": 1},
    **{"gaussians": 2, "width": 8, "memory": 8},
)


def test_a_share_is_of_the_attainable_rate() -> None:
    assert Cost(ms=2.0, gflop=0.1, attainable_gflops=100.0).share == pytest.approx(0.5)


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


def test_where_nothing_can_be_written_nothing_is_measured(tmp_path: Path) -> None:
    from mbdpg.cli import main

    with pytest.raises(SystemExit, match="--json is .*, a folder; expected a file's name"):
        main(["benchmark", "--json", str(tmp_path)])


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
    seconds = [numbers[f"{name}_gflop"] / numbers[f"{name}_attainable_gflops"] for name in ("improve", "fit")]
    both = numbers["improve_gflop"] + numbers["fit_gflop"]
    assert numbers["attainable_gflops"] == pytest.approx(both / sum(seconds))
    assert 0 < numbers["warm_start_s"] < numbers["cold_start_s"] and numbers["peak_memory_mb"] > 100
    assert numbers["growth_ms"]["seeds"]["improving"]["2"] > 0 and numbers["growth_ms"]["seeds"]["fitting"]["2"] > 0
    rows = capsys.readouterr().out.splitlines()
    for number, unit in (("improve_ms", "ms"), ("ground_ms", "ms"), ("cold_start_s", "s"), ("policy_us", "us")):
        assert any(f" {numbers[number]:.1f} {unit}  " in row for row in rows), number
    assert any(row.startswith("peak memory ") and "3,000 steps" in row for row in rows)
