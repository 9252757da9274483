"""A study's figure and tables: numbers as recorded, time over resumes, and what made them."""

from __future__ import annotations

import csv
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from mbdpg.reports.figures import write_figure
from mbdpg.reports.panels import Curves, Errors
from mbdpg.reports.record import Record
from mbdpg.storage.metrics import MetricsLog
from mbdpg.storage.run_folder import RunFolder

MACHINE = {"cpu": "Fast", "cores": 2, "platform": "Linux-6.1-x86_64"}


def make(path: Path, returns: dict[int, float | None], *, seconds: tuple[float, ...] = (), expert: int = 0) -> Record:
    """A run with these evaluations."""
    RunFolder.create(path, {"env": "E-v0", "algorithm": "td3", "commit": "e" * 40, "machine": MACHINE})
    log = MetricsLog(path)
    for i, (step, value) in enumerate(returns.items()):
        row: dict[str, float] = {"expert_env_steps": expert} | ({"time/seconds": seconds[i]} if seconds else {})
        log.write("eval", step, row if value is None else row | {"eval/return_mean": value})
    log.close()
    return Record.read(path, root=path.parent)


def rows_in(lines: list[str]) -> list[list[str]]:
    """The cells of all tables, but for the rules below their heads."""
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in lines if line.startswith("| ")]


def errors(path: Path, scale: float) -> Path:
    path.parent.mkdir(exist_ok=True)
    rows = [f"{depth},{scale * depth},{5.0}" for depth in range(1, 201)]
    path.write_text("\n".join(["depth,rmse,persistence", *rows]))
    return path


def test_hours_go_on_over_failed_evaluations(tmp_path: Path) -> None:
    run = make(tmp_path / "run", {0: 1.0, 10: None, 20: 3.0, 30: 4.0}, seconds=(360.0, 720.0, 900.0, 1080.0), expert=7)
    [found] = Curves("E-v0", {"td3": [run]}).evaluations()["td3"]
    assert list(found) == [0, 20, 30] and {one.expert_env_steps for one in found.values()} == {7}
    assert [one.hours for one in found.values()] == pytest.approx([0.1, 0.25, 0.3])


def test_no_line_or_band_crosses_an_evaluation_that_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They went straight on, as if it had been between the others."""
    seeds = [make(tmp_path / f"seed-{i}", {0: 1.0, 10: 2.0, 20: 3.0, 30: 4.0}) for i in range(4)]
    seeds.append(make(tmp_path / "seed-4", {0: 1.0, 10: None, 20: 3.0, 30: 4.0}))
    rows: list[Any] = []

    def note(figure: Figure, *_: Any, save: Any = Figure.savefig, **settings: Any) -> None:
        rows.extend(figure.axes)
        save(figure, *_, **settings)

    monkeypatch.setattr(Figure, "savefig", note)
    lines = write_figure("figure-x", [Curves("E-v0", {"td3": seeds})], tmp_path)
    assert len(rows) == 3
    for axes in rows:
        [line] = axes.get_lines()
        assert line.get_xdata().tolist() == [0, 10, 20, 30]
        np.testing.assert_array_equal(line.get_ydata(), [1.0, np.nan, 3.0, 4.0])
        assert len(axes.collections[0].get_paths()) == 2  # before it and after it
    assert rows_in(lines)[1][:4] == ["td3", "5", "30", "4.0"]
    with open(tmp_path / "figure-x.csv", newline="") as file:
        assert [row["env_steps"] for row in csv.DictReader(file) if row["seed"] == "4"] == ["0", "20", "30"]


def test_a_figure_has_its_numbers_beside_it(tmp_path: Path) -> None:
    td3 = [make(tmp_path / "td3" / f"seed-{i}", {0: 0.0, 10: 5.0 + i, 20: 99.0}) for i in range(2)]
    sac = [make(tmp_path / "sac" / "seed-0", {0: 0.0, 10: 1.0}, expert=40)]
    fits = [errors(tmp_path / "models" / f"seed-{i}.csv", 1.0 + i) for i in range(2)]
    panels = [Errors("models", {"mixture": {file: {} for file in fits}}), Curves("E-v0", {"td3": td3, "sac": sac})]
    lines = write_figure("figure-x", panels, tmp_path)
    assert rows_in(lines) == [
        ["error (standard deviations) after", "seeds", "1 step", "10 steps", "50 steps", "200 steps"],
        ["mixture", "2", "1.500 ± 0.707", "15.000 ± 7.071", "75.000 ± 35.355", "300.000 ± 141.421"],
        ["no change at all", "", "5.000", "5.000", "5.000", "5.000"],
        ["", "seeds", "steps", "return", "std", "interquartile mean", "95 % interval", "hours"],
        ["td3", "2", "20", "99.0", "0.0", "99.0", "99.0 to 99.0", ""],
        ["sac", "1", "10", "1.0", "", "", "", ""],
    ]
    with open(tmp_path / "figure-x.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 200 + 2 * 3 + 2
    assert rows[-1] == {
        **{"panel": "E-v0", "label": "sac", "seed": "0", "env_steps": "10", "expert_env_steps": "40"},
        **{"return_mean": "1.0", "hours": "", "depth": "", "rmse": "", "persistence": ""},
    }
    assert (tmp_path / "figure-x.png").read_bytes().startswith(b"\x89PNG")


def test_a_table_of_hours_is_in_multiples_of_td3(tmp_path: Path) -> None:
    runs = {
        "td3": [make(tmp_path / f"td3-{i}", {0: 0.0, 10: 1.0}, seconds=(0.0, 1800.0 * (1 + i))) for i in range(2)],
        "mbdpg": [make(tmp_path / "mbdpg", {0: 0.0, 10: 1.0, 20: 1.0}, seconds=(0.0, 5400.0, 9999.0))],
    }
    lines = write_figure("table-x", [Curves("E-v0", runs)], tmp_path, as_hours=True)
    assert rows_in(lines) == [
        ["", "seeds", "steps", "hours", "÷ td3", "machine"],
        ["td3", "2", "10", "0.75", "1.0", "Fast, 2 cores, Linux"],
        ["mbdpg", "1", "10", "1.50", "2.0", "Fast, 2 cores, Linux"],
    ]
    published = [Curves("E-v0", runs, {"td3": 4.0, "pets": 9.0})]
    lines = write_figure("table-x", published, tmp_path, as_hours=True)
    assert [row[5:7] for row in rows_in(lines)] == [["paper's hours", "paper's ÷ td3"], ["4.0", "1.0"], ["", ""]]
    assert not (tmp_path / "table-x.png").exists()


def test_missing_timings_are_not_taken_for_no_time(tmp_path: Path) -> None:
    """They counted as 0 hours, in the file and in the mean; then nothing said that the mean was of fewer."""
    timed = make(tmp_path / "a", {0: 0.0, 10: 1.0}, seconds=(0.0, 7200.0))
    runs = {"td3": [timed, make(tmp_path / "b", {0: 0.0, 10: 1.0})], "sac": [make(tmp_path / "c", {0: 0.0, 10: 1.0})]}
    lines = write_figure("table-x", [Curves("E-v0", runs)], tmp_path, as_hours=True)
    assert [row[:5] for row in rows_in(lines)[1:]] == [
        ["td3", "2", "10", "2.00 (1 of 2)", "1.0"],
        ["sac", "1", "10", "", ""],
    ]
    with open(tmp_path / "table-x.csv", newline="") as file:
        assert [row["hours"] for row in csv.DictReader(file)] == ["0.0", "2.0", "", "", "", ""]


def test_runs_without_a_common_step_are_left_out_of_the_picture(tmp_path: Path) -> None:
    runs = {"a": [make(tmp_path / "a", {0: 1.0}), make(tmp_path / "b", {5: 1.0})], "none": []}
    lines = write_figure("figure-x", [Curves("E-v0", runs)], tmp_path)
    assert lines[3:6] == ["## E-v0", "", "Nothing to compare yet."]


def test_models_that_all_failed_leave_an_empty_picture_without_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "Nothing to compare yet." in write_figure("figure-x", [Errors("models", {})], tmp_path)
    assert caplog.records == []


def test_tables_lie_in_a_file_that_says_what_made_them(tmp_path: Path) -> None:
    """They were printed alone, and nothing said at which commit and on which machine."""
    td3 = [make(tmp_path / "td3" / f"seed-{i}", {0: 0.0, 10: 5.0}) for i in range(2)]
    fits = {errors(tmp_path / "models" / "seed-0.csv", 1.0): {"commit": "f" * 40 + "+", "machine": MACHINE}}
    fits |= {errors(tmp_path / "models" / "seed-1.csv", 1.0): {}}  # of before origins were noted
    panels = [Curves("E-v0", {"td3": td3}), Curves("again", {"td3": td3}), Errors("models", {"mixture": fits})]
    lines = write_figure("figure-x", panels, tmp_path, heading=["`mbdpg reproduce`", "The paper says: yes."])
    text = (tmp_path / "figure-x.md").read_text()
    assert text.startswith("# figure-x\n\n`mbdpg reproduce`\n\nThe paper says: yes.\n\n## E-v0\n\n| ")
    assert text.endswith("\n".join(lines[3:]) + "\n")
    assert lines[-3:] == [
        "- 2 of 4: commit eeeeeeeeee, on Fast, 2 cores, Linux",
        "- 1 of 4: commit ffffffffff+, on Fast, 2 cores, Linux",
        "- 1 of 4: commit —, on a machine that is not noted",
    ]
