"""What the README shows works as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

README = (Path(__file__).parent.parent / "README.md").read_text()


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
        assert (Path(__file__).parent.parent / name).exists(), name
