"""Learning curves: what is drawn from which rows."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D

from mbdpg.interfaces import UserError
from mbdpg.reports import curves
from mbdpg.storage.metrics import MetricsLog


def run_with(folder: Path, returns: dict[int, float], kind: str = "eval") -> Path:
    folder.mkdir()
    with MetricsLog(folder) as log:
        for env_steps, value in returns.items():
            log.write(kind, env_steps, {"eval/return_mean": value})
    return folder


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """The lines of every picture that is saved: (environment steps, returns, label)."""
    lines: list[Any] = []
    save = matplotlib.figure.Figure.savefig

    def note(figure: Any, path: Path, **settings: Any) -> None:
        for line in figure.axes[0].get_lines():
            lines.append((line.get_xdata().tolist(), line.get_ydata().tolist(), line.get_label()))
        save(figure, path, **settings)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", note)
    monkeypatch.setattr(Line2D, "get_xdata", lambda self, orig=True, get=Line2D.get_xdata: np.asarray(get(self)))
    monkeypatch.setattr(Line2D, "get_ydata", lambda self, orig=True, get=Line2D.get_ydata: np.asarray(get(self)))
    yield lines
    assert plt.get_fignums() == []


def test_each_run_is_a_line_and_their_mean_is_one_more(tmp_path: Path, drawn: list[Any]) -> None:
    runs = [run_with(tmp_path / "a", {0: 1.0, 100: 2.0, 200: 9.0}), run_with(tmp_path / "b", {0: 3.0, 100: 6.0})]
    curves.draw_curves({"mbdpg": runs}, tmp_path / "curve.png", title="Pendulum-v1")
    assert [line[:2] for line in drawn] == [([0, 100, 200], [1, 2, 9]), ([0, 100], [3, 6]), ([0, 100], [2, 4])]
    assert drawn[2][2] == "mbdpg (2 seeds)"
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_a_link_in_the_place_of_the_picture_is_replaced_and_not_followed(tmp_path: Path, drawn: list[Any]) -> None:
    (tmp_path / "mine").write_text("precious")
    (tmp_path / "curve.png").symlink_to(tmp_path / "mine")
    curves.draw_curves({"mbdpg": [run_with(tmp_path / "a", {0: 1.0})]}, tmp_path / "curve.png", title="")
    assert (tmp_path / "mine").read_text() == "precious"
    assert not (tmp_path / "curve.png").is_symlink()
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_groups_are_drawn_side_by_side_and_one_without_an_evaluation_is_left_out(
    tmp_path: Path, drawn: list[Any]
) -> None:
    groups = {
        "mbdpg": [run_with(tmp_path / "a", {0: 1.0})],
        "new": [run_with(tmp_path / "b", {0: 1.0}, kind="train")],
        "td3": [run_with(tmp_path / "c", {0: 5.0})],
    }
    curves.draw_curves(groups, tmp_path / "curve.png", title="")
    assert [line[2] for line in drawn if "seed" in line[2]] == ["mbdpg (1 seed)", "td3 (1 seed)"]


def test_an_evaluation_in_which_every_episode_failed_is_a_gap(tmp_path: Path, drawn: list[Any]) -> None:
    """The line went straight on."""
    failed = run_with(tmp_path / "a", {0: 1.0, 100: float("nan"), 200: 3.0})
    runs = [failed, run_with(tmp_path / "b", {0: 3.0, 100: 1.0, 200: 5.0})]
    curves.draw_curves({"mbdpg": runs}, tmp_path / "curve.png", title="")
    for (steps, returns, _), ends in zip((drawn[0], drawn[2]), ((1, 3), (2, 4)), strict=True):
        assert steps == [0, 100, 200] and (returns[0], returns[2]) == ends and np.isnan(returns[1])


def test_without_any_evaluation_one_line_says_what_to_do(tmp_path: Path) -> None:
    runs = [run_with(tmp_path / "a", {0: 1.0}, kind="train"), run_with(tmp_path / "b", {0: float("nan")})]
    with pytest.raises(UserError, match="no run has an evaluation yet; train until the first one"):
        curves.draw_curves({"mbdpg": runs}, tmp_path / "curve.png", title="")
    assert plt.get_fignums() == [] and not (tmp_path / "curve.png").exists()


def test_a_folder_that_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"has no metrics.jsonl; expected the folder of a run"):
        curves.draw_curves({"mbdpg": [tmp_path]}, tmp_path / "curve.png", title="")
    assert plt.get_fignums() == []


def test_where_no_picture_can_be_written_one_line_says_so(tmp_path: Path) -> None:
    runs = [run_with(tmp_path / "a", {0: 1.0})]
    with pytest.raises(UserError, match="cannot write .*curve.png: No such file or directory"):
        curves.draw_curves({"mbdpg": runs}, tmp_path / "missing" / "curve.png", title="")
    assert plt.get_fignums() == []


def test_drawing_needs_no_display_and_leaves_no_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    runs = [run_with(tmp_path / "a", {0: 1.0})]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        curves.draw_curves({"mbdpg": runs}, tmp_path / "curve.png", title="$x_1$")
    assert plt.get_backend().lower() == "agg"
