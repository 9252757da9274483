"""Dynamics models on recorded steps: what they learn from, what they are tested on, and what is written."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbdpg.agents.mbdpg import Config
from mbdpg.experiments import model_study
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.model_study import ModelFit, Recorded
from mbdpg.interfaces import UserError
from mbdpg.storage.checkpoint import Checkpoint
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.replay import Replay

LENGTHS = (5, 9, 5, 5, 12, 5, 5, 5, 5, 3)
SMALL = Config(width=8, memory=4, gaussians=1, fit_batch_size=4, burn_in=2, fit_length=2)


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> Recorded:
    """Pendulum's sizes; the fifth and the tenth of ten episodes are held out, and only the fifth is long enough."""
    monkeypatch.setattr(model_study, "STEPS", 6)
    replay, rng = Replay(3, 1), np.random.default_rng(0)
    for length in LENGTHS:
        for step in range(length):
            before, action = rng.normal(size=3).astype(np.float32), rng.uniform(-1, 1, 1).astype(np.float32)
            replay.add(before, action, 0.0, 0.5 * before + action, False, step == length - 1)
    saved = Checkpoint(0, {}, {}, replay.columns())
    monkeypatch.setattr(model_study, "load_checkpoint", lambda run: saved)
    return Recorded.load(Path("run"), sum(LENGTHS))


def test_episodes_are_learned_from_or_tested_on(recorded: Recorded) -> None:
    starts = np.cumsum((0, *LENGTHS))
    held_out = {*range(starts[4], starts[5]), *range(starts[9], starts[10])}
    assert set(recorded.learned) == set(range(starts[-1])) - held_out
    assert list(recorded.tested) == list(range(starts[4], starts[4] + 7))  # whose six steps stay in the episode


def test_a_bootstrap_sample_is_of_whole_episodes_learned_from(recorded: Recorded) -> None:
    starts = recorded.replay.columns()["start"]
    rows = recorded.resampled(np.random.default_rng(0))
    assert set(rows) < set(recorded.learned)
    counts = {int(start): np.sum(starts[rows] == start) for start in set(starts[rows])}
    lengths = dict(zip(np.cumsum((0, *LENGTHS[:-1])), LENGTHS, strict=True))
    assert all(count % lengths[start] == 0 for start, count in counts.items())
    assert sum(count // lengths[start] for start, count in counts.items()) == 8


def test_too_short_episodes_are_refused_in_one_line(recorded: Recorded, monkeypatch: Any) -> None:
    monkeypatch.setattr(model_study, "STEPS", 13)
    with pytest.raises(UserError, match="run has no episode of 13 steps to test on .*; train it for longer"):
        Recorded.load(Path("run"), sum(LENGTHS))


def test_steps_that_a_run_was_resumed_for_are_not_among_those_of_a_study(recorded: Recorded) -> None:
    """Models that were fitted before had learned from fewer, and were drawn beside them."""
    first = Recorded.load(Path("run"), sum(LENGTHS[:8]))
    assert first.replay.size == sum(LENGTHS[:8]) and set(first.learned) < set(recorded.learned)
    assert list(first.tested) == list(recorded.tested)


@pytest.mark.parametrize(
    ("kind", "count"), [("none", 1), pytest.param("bagging", 2, marks=pytest.mark.slow), ("boosting", 2)]
)
def test_a_fit_leaves_the_errors_of_its_model(
    recorded: Recorded, kind: Any, count: int, tmp_path: Path, monkeypatch: Any
) -> None:
    config = RunConfig("Pendulum-v1").to_json()
    monkeypatch.setattr(model_study.RunFolder, "open", lambda path: RunFolder(path, config))
    out = tmp_path / "models" / "seed-0.csv"
    fit = ModelFit("m", SMALL, 3, Path("run"), sum(LENGTHS), 0, out, kind, count)
    with pytest.raises(UserError, match=f"run has saved {sum(LENGTHS)} of 100 steps to learn from; go on with it"):
        dataclasses.replace(fit, data_steps=100)(lambda: False)
    assert not fit.finished()
    fit(lambda: True)
    assert not fit.finished()
    fit(lambda: False)
    assert fit.finished() and out.read_text().startswith("depth,rmse,persistence\n1,")
    whole = out.read_bytes()
    for part in (b"", whole[: len(whole) // 2], whole[:-3], whole.rsplit(b"\n", 2)[0] + b"\n"):
        out.write_bytes(part)  # a part of it was drawn as if it were all
        assert not fit.finished()
    out.write_bytes(whole)
    table = np.loadtxt(out, delimiter=",", skiprows=1)
    assert table.shape == (6, 3) and list(table[:, 0]) == [1, 2, 3, 4, 5, 6] and np.isfinite(table).all()
    longer = dataclasses.replace(fit, updates=600, out=tmp_path / "longer.csv")
    longer(lambda: False)
    learned = np.loadtxt(longer.out, delimiter=",", skiprows=1)
    assert (learned[:, 2] == table[:, 2]).all() and learned[0, 1] < min(0.9 * learned[0, 2], table[0, 1])
    other = dataclasses.replace(fit, updates=4)
    assert not other.finished()
    with pytest.raises(UserError, match=r"seed-0.csv was made with other settings"):
        other(lambda: False)
    assert fit.finished()
