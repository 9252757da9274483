"""Made-up run folders."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mbdpg.storage.metrics import MetricsLog
from mbdpg.storage.run_folder import RunFolder


@pytest.fixture
def make() -> Callable[..., Path]:
    """Makes a run folder."""
    return make_run


SEEDS = itertools.count()
"""Each run has its own."""


def make_run(
    path: Path,
    returns: dict[int, float | None],
    *,
    algorithm: str = "td3",
    env: str = "E-v0",
    config: dict[str, Any] | None = None,
    evaluations: dict[int, dict[str, Any]] | None = None,
    training: dict[int, dict[str, Any]] | None = None,
    **agent: Any,
) -> Path:
    """A run folder with these returns, these settings, and more values in the rows of these steps."""
    default = {"env": env, "algorithm": algorithm, "agent": {"width": 8, "discount": 0.9} | agent, "env_options": {}}
    seed = next(SEEDS)
    RunFolder.create(path, default | {"demonstrations": None, "seed": seed} | (config or {}))
    with MetricsLog(path) as log:
        for step, value in returns.items():
            row = {} if value is None else {"eval/return_mean": value}
            log.write("eval", step, row | (evaluations or {}).get(step, {}))
        for step, values in (training or {}).items():
            log.write("train", step, values)
    return path
