"""The page: what it holds, and that nothing which was read can act in it."""

import base64
import hashlib
import json
import os
import re
import subprocess
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from mbdpg.interfaces import UserError
from mbdpg.reports import contents as contents_module
from mbdpg.reports.comparison import run_folders
from mbdpg.reports.contents import compared, contents
from mbdpg.reports.page import page, write_page
from mbdpg.reports.record import read_records
from mbdpg.storage.files import require_place

Make = Callable[..., Path]
ROOT = Path(__file__).resolve().parents[2]
HOSTILE = "</script><img src=x onerror=alert(1)><!--\u2028$data&amp;"


def content_of(*paths: Path, at: int | None = None) -> dict[str, Any]:
    return contents(compared(read_records(run_folders(paths), leave_out=pytest.fail), at=at))


def data_in(html: str) -> dict[str, Any]:
    """The JSON as a browser sees it: until the first end of a script."""
    block = html.split('<script type="application/json" id="data">')[1].split("</script>")[0]
    return json.loads(block)


def tables_of(content: dict[str, Any]) -> dict[str, list[list[str]]]:
    (own,) = content["environments"]
    return {
        table["title"]: table["rows"] for table in [*own["scores"], own["clock"], own["problems"], *own["settings"]]
    }


def test_curves_have_each_run_over_each_axis(tmp_path: Path, make: Make) -> None:
    rows = {0: {"expert_env_steps": 7, "time/seconds": 36.0}, 100: {"expert_env_steps": 7, "time/seconds": 360.0}}
    make(tmp_path / "a" / "seed-0", {0: 1.0, 100: 2.0}, evaluations=rows)
    make(tmp_path / "b" / "seed-0", {0: 3.0})
    (own,) = content_of(tmp_path)["environments"]
    (group,) = own["groups"]
    assert own["name"] == "E-v0" and group["label"] == "td3"
    assert group["runs"][0] == {
        "name": "a/seed-0",
        "axes": {"steps": [0, 100], "expert": [7, 107], "hours": [0.01, 0.1]},
        "series": {"return": [1.0, 2.0]},
    }
    assert group["runs"][1]["axes"] == {"steps": [0], "expert": [None], "hours": [None]}


def test_scores_are_those_of_the_printed_table(tmp_path: Path, make: Make) -> None:
    for seed in range(2):
        make(tmp_path / f"good-{seed}", {0: 0.0, 50: 10.0 + seed, 100: 30.0}, width=16)
    make(tmp_path / "bad", {0: 0.0, 50: 10.5})
    tables = tables_of(content_of(tmp_path))
    assert tables["Return at 50 steps"] == [
        ["td3 width=8", "1", "10.5", "", "", "", ""],
        ["td3 width=16", "2", "10.5", "0.7", "10.5", "10.0 to 11.0", "50%"],
    ]
    last = tables["Return at the last evaluation of each run"]
    assert last == [
        ["td3 width=8", "50", "1", "10.5", "", "", "", "100%"],
        ["td3 width=16", "100", "2", "30.0", "0.0", "30.0", "30.0 to 30.0", ""],
    ]
    assert "Return at 0 steps" in tables_of(content_of(tmp_path, at=0))


def test_a_single_run_has_one_table_of_scores(tmp_path: Path, make: Make) -> None:
    tables = tables_of(content_of(make(tmp_path / "a", {0: 0.0, 50: 1.5})))
    assert tables["Return at 50 steps, the last evaluation of every run"] == [["td3", "1", "1.5", "", "", ""]]


def test_without_a_common_step_a_note_says_so_and_the_last_evaluations_remain(tmp_path: Path, make: Make) -> None:
    make(tmp_path / "a", {0: 1.0})
    make(tmp_path / "b", {5: 2.0})
    content = content_of(tmp_path)
    (own,) = content["environments"]
    assert "no evaluation at the same step" in own["notes"][0]
    assert next(iter(tables_of(content))) == "Return at the last evaluation of each run"
    assert own["scores"][0]["rows"] == [["td3", "0 – 5", "2", "1.5", "0.7", "1.5", "1.0 to 2.0"]]


def test_wall_clock_is_compared_with_td3_at_the_same_step(tmp_path: Path, make: Make) -> None:
    machine = {"machine": {"cpu": "Fast", "cores": 2, "platform": "Linux-6.1-x86_64"}}
    hour = {100: {"time/seconds": 3600.0}, 200: {"time/seconds": 7200.0}}
    make(tmp_path / "a", {100: 0.0, 200: 1.0}, evaluations=hour, config=machine)
    three = {100: {"time/seconds": 3 * 3600.0}}
    make(tmp_path / "b", {100: 0.0}, algorithm="sac", evaluations=three, config=machine)
    assert tables_of(content_of(tmp_path))["Wall-clock hours, mean per run"] == [
        ["td3", "1.00", "1.00", "2.00", "Fast, 2 cores, Linux"],
        ["sac", "3.00", "3.00", "3.00", "Fast, 2 cores, Linux"],
    ]


def test_diagnostics_are_there_for_what_was_recorded(tmp_path: Path, make: Make) -> None:
    row = {"dynamics/rmse_k05": 1.0, "dynamics/persistence_k05": 4.0, "dynamics/reward_bias": -0.5}
    row |= {"dynamics/return_imagined": 3.0, "dynamics/return_observed": 2.5}
    row |= {"critic/q_bias": -2.0, "critic/realized_return": 10.0, "dynamics/survival_observed": 1.0}
    zero = {"dynamics/rmse_k05": 1.0, "dynamics/persistence_k05": 0.0, "dynamics/rmse_k20": "odd"}
    run = make(tmp_path / "a", {0: 1.0, 10: 1.0}, evaluations={0: row, 10: zero})
    (own,) = content_of(run)["environments"]
    assert own["groups"][0]["runs"][0]["series"] == {
        "return": [1.0, 1.0],
        "error_5": [0.25, None],
        "reward_bias": [-0.5, None],
        "value": [8.0, None],
        "realized": [10.0, None],
        "return_imagined": [3.0, None],
        "return_observed": [2.5, None],
        "survival_observed": [1.0, None],
    }
    assert [chart["title"] for chart in own["charts"]] == [
        "Mean evaluation return",
        "Model error 5 steps ahead",
        "Critic's value and realized return",
        "Return of 20 steps",
        "Survival over 20 steps",
        "Reward bias",
    ]
    assert own["charts"][1]["reference"] == 1.0


def test_settings_that_differ_are_listed_by_group_and_run(tmp_path: Path, make: Make) -> None:
    versions = [{"commit": f"{i}" * 40, "machine": {"versions": {"jax": "1"}, "cores": 2}} for i in range(2)]
    make(tmp_path / "a", {0: 1.0}, config=versions[0])
    make(tmp_path / "b", {0: 1.0}, config=versions[1])
    make(tmp_path / "c", {0: 1.0}, algorithm="sac", config=versions[1], temperature=2, width=9)
    tables = tables_of(content_of(tmp_path))
    assert tables["Settings that differ"] == [
        ["algorithm", "td3", "sac"],
        ["commit", "0000000000 (a); 1111111111 (b)", "1111111111"],
        ["agent width", "8", "9"],
    ]
    assert tables["Settings that only some algorithms have"] == [["agent temperature", "", "2"]]


def test_a_commit_with_changes_is_not_taken_for_the_one_without(tmp_path: Path, make: Make) -> None:
    """The + behind it was cut off, and the runs seemed to be of the same code."""
    make(tmp_path / "a", {0: 1.0}, config={"commit": "0" * 40})
    make(tmp_path / "b", {0: 1.0}, config={"commit": "0" * 40 + "+"})
    tables = tables_of(content_of(tmp_path))
    assert tables["Settings that differ"] == [["commit", "0000000000 (a); 0000000000+ (b)"]]


def test_problems_name_their_run(tmp_path: Path, make: Make) -> None:
    run = make(tmp_path / "runs" / "a", {0: 1.0}, config={"schedule": {"steps": 10}})
    assert tables_of(content_of(run))["Did not go as planned"] == [["td3", "a", "reached 0 of 10 planned steps"]]


def test_videos_are_embedded_or_named(tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contents_module, "MAX_VIDEO_BYTES", 1 << 20)
    runs = [make(tmp_path / "out" / f"seed-{i}", {0: 1.0}) for i in range(2)]
    (tmp_path / "out" / "policy.mp4").write_bytes(b"film")
    (tmp_path / "out" / "seed-1" / "long.mp4").write_bytes(b"0" * (3 << 19))
    (tmp_path / "out" / "seed-1" / "link.mp4").symlink_to("/etc/passwd")
    (tmp_path / "out" / "seed-1" / "note.txt").write_text("")
    assert sorted(content_of(*runs)["videos"], key=lambda video: video["name"]) == [
        {"name": "policy.mp4", "source": "data:video/mp4;base64," + base64.b64encode(b"film").decode()},
        {"name": "seed-1/link.mp4", "note": "not embedded: it is no file that can be read (links are not followed)"},
        {"name": "seed-1/long.mp4", "note": "not embedded: 1.5 MiB, more than 1"},
    ]


def test_hostile_text_stays_text(tmp_path: Path, make: Make) -> None:
    odd = {"machine": {"cpu": HOSTILE, "versions": [1]}, "schedule": HOSTILE, "commit": {HOSTILE: 1}}
    make(tmp_path / "a", {0: 1.0}, env=HOSTILE, algorithm=HOSTILE, config=odd)
    make(tmp_path / "b", {0: 1.0}, env=HOSTILE, algorithm=HOSTILE, width=HOSTILE)
    content = content_of(tmp_path)
    html = page(content)
    assert data_in(html) == content and content["environments"][0]["name"] == HOSTILE
    assert html.count("</script>") == html.count("<script") == 2 and "<img" not in html and "\u2028" not in html
    assert "innerHTML" not in html and "document.write" not in html


def test_what_is_missing_is_null(tmp_path: Path, make: Make) -> None:
    run = make(tmp_path / "a", {0: 1.0, 5: float("nan"), 10: 2.0})
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "eval", "env_steps": 15, "eval/return_mean": NaN, "eval/faults": Infinity}\n')
    html = page(content_of(run))
    assert data_in(html)["environments"][0]["groups"][0]["runs"][0]["series"]["return"] == [1.0, None, 2.0, None]
    assert "NaN" not in html.split('id="data">')[1].split("</script>")[0]


def test_the_policy_allows_this_script_and_style_and_no_network(tmp_path: Path, make: Make) -> None:
    html = page(content_of(make(tmp_path / "a", {0: 1.0})))
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]+)"', html)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    for name, pattern in (("script-src", r"<script>(.*?)</script>"), ("style-src", r"<style>(.*?)</style>")):
        (text,) = re.findall(pattern, html, re.DOTALL)
        assert rules.pop(name) == f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
    assert rules == {"default-src": "'none'", "media-src": "data:", "base-uri": "'none'", "form-action": "'none'"}
    assert not re.findall(r"https?://(?!www\.w3\.org/2000/svg)", html)


def test_a_link_in_the_place_of_the_page_is_replaced_and_not_followed(tmp_path: Path, make: Make) -> None:
    (tmp_path / "mine").write_text("precious")
    path = tmp_path / "page.html"
    path.symlink_to(tmp_path / "mine")
    (tmp_path / ".tmp-page.html").write_text("left by a crash")
    require_place(path, "--out", suffix=".html")
    write_page(path, content_of(make(tmp_path / "a", {0: 1.0})))
    assert (tmp_path / "mine").read_text() == "precious" and not path.is_symlink()
    assert sorted(os.listdir(tmp_path)) == ["a", "mine", "page.html"]


def test_where_no_page_can_be_written_one_line_says_so(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot write .*page.html: No such file or directory"):
        write_page(tmp_path / "missing" / "page.html", {})


@pytest.mark.parametrize("name", ["page.html", "page.css", "page.js", "chart.js"])
def test_its_parts_are_in_the_package_that_is_built(name: str) -> None:
    """The wheel has all of `mbdpg/` that git does not ignore."""
    assert resources.files("mbdpg.reports").joinpath(name).is_file()
    ignored = subprocess.run(["git", "check-ignore", f"mbdpg/reports/{name}"], cwd=ROOT, check=False).returncode
    assert ignored != 0
