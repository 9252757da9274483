"""What the README shows works as it stands there."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from mbdpg.reports.statistics import summarize

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_python_example_trains_its_own_environment_and_acts(tmp_path: Path) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.strip().splitlines()
    assert [line.split()[0] for line in lines[:-1]] == ["0", "500", "1000"]
    action = float(lines[-1].strip("[]"))
    assert -1.0 <= action <= 1.0


def test_verbs_and_flags_in_the_readme_exist() -> None:
    from mbdpg.cli import VERBS

    used = re.findall(r"^mbdpg (\w+)", README, re.MULTILINE)
    assert used and set(used) <= set(VERBS)
    for name in re.findall(r"\]\(([a-zA-Z0-9_/.-]+)\)", README):
        assert (ROOT / name).exists(), name


def collect() -> Any:
    """The script that reads what results/ has, which is no package."""
    spec = importlib.util.spec_from_file_location("collect", ROOT / "results" / "collect.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_numbers_of_the_results_table_are_those_of_its_csv_files() -> None:
    script = collect()
    number = r"(?P<mean>[−\d,]+)(?: ± (?P<std>[\d,]+))? \((?P<seeds>\d+)"
    compared = 0
    for name in script.TASKS:
        env, curves = script.read(name)
        (row,) = re.findall(rf"^\| {env}[^|]*\|(.*)\|$", README, re.MULTILINE)
        at_50, at_100, _, rivals = row.split("|")
        told = [("mbdpg", 50_000, at_50), ("mbdpg", 100_000, at_100)]
        told += [(word.split()[0].lower(), 50_000, word) for word in rivals.split(", ")]
        for algorithm, budget, text in told:
            found = re.search(number, text)
            assert found, f"{env}: {text!r} has no number of seeds"
            of_seeds = summarize([curve[budget] for curve in curves[algorithm].values() if budget in curve])
            shown = found["mean"].replace("−", "-"), found["std"] or "0", int(found["seeds"])
            std = f"{of_seeds.std:,.0f}" if found["std"] else "0"
            assert shown == (f"{of_seeds.mean:,.0f}", std, of_seeds.seeds), f"{env} {algorithm} at {budget:,}"
            compared += 1
    assert compared >= 4 * len(script.TASKS)
