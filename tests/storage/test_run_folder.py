import json
import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from mbdpg.interfaces import UserError
from mbdpg.storage import run_folder
from mbdpg.storage.run_folder import RunFolder, describe_machine

ROOT = Path(__file__).resolve().parents[2]
CONFIG = {"seed": 3, "rate": 1 / 3, "limit": float("inf"), "sizes": [64, 64], "machine": {"cores": 2}, "é": None}


def tree(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_run_opens_with_the_config_it_was_made_with(tmp_path: Path) -> None:
    made = RunFolder.create(tmp_path / "new" / "parents" / "run", CONFIG)
    assert RunFolder.open(made.path) == made
    assert made.config == CONFIG
    assert tree(made.path) == ["config.json"]
    written = json.loads((made.path / "config.json").read_text())
    assert (written["format"], written["version"], written["run"]["seed"]) == ("mbdpg-run", 1, 3)


def test_an_empty_folder_will_do(tmp_path: Path) -> None:
    assert RunFolder.create(tmp_path, CONFIG) == RunFolder.open(tmp_path)


@pytest.mark.parametrize("occupant", ["config.json", "notes.txt", ".tmp-config.json"])
def test_a_folder_with_anything_in_it_is_refused_and_left_alone(tmp_path: Path, occupant: str) -> None:
    (tmp_path / occupant).write_text("mine")
    with pytest.raises(UserError, match=r"is not empty \(.*\); resume it or choose another --out"):
        RunFolder.create(tmp_path, CONFIG)
    assert tree(tmp_path) == [occupant]
    assert (tmp_path / occupant).read_text() == "mine"


def test_a_run_that_another_process_makes_meanwhile_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def outrun(path: Path, data: bytes) -> None:
        (tmp_path / "config.json").write_text("theirs")
        path.write_bytes(data)

    monkeypatch.setattr(run_folder, "write_durably", outrun)
    with pytest.raises(UserError, match="is not empty"):
        RunFolder.create(tmp_path, CONFIG)
    assert tree(tmp_path) == ["config.json"]
    assert (tmp_path / "config.json").read_text() == "theirs"


def test_where_no_folder_can_be_nothing_is_left_behind(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in ("file", "file/run", "new/" + "x" * 300):
        with pytest.raises(UserError, match="choose another --out") as caught:
            RunFolder.create(tmp_path / out, CONFIG)
        assert "\n" not in str(caught.value)
        assert tree(tmp_path) == ["file"]


@pytest.mark.parametrize(("call", "times"), [("mkdir", 3), ("fsync", 3), ("replace", 1)])
def test_a_disk_that_refuses_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, times: int
) -> None:
    original = getattr(os, call)
    left = 0

    def fail(*args: object) -> object:
        nonlocal left
        left -= 1
        if left == 0:
            raise PermissionError(13, "Permission denied")
        return original(*args)

    monkeypatch.setattr(os, call, fail)
    for failing in range(1, times + 1):
        left = failing
        with pytest.raises(UserError, match="Permission denied; choose another --out"):
            RunFolder.create(tmp_path / "a" / "b" / "c", CONFIG)
        assert tree(tmp_path) == []
    left = 0
    RunFolder.create(tmp_path / "a" / "b" / "c", CONFIG)
    assert left == -times


@pytest.mark.parametrize("config", [{"x": object()}, {"x": {1, 2}}])
def test_a_config_that_is_not_json_leaves_nothing_behind(tmp_path: Path, config: dict[str, object]) -> None:
    with pytest.raises(TypeError):
        RunFolder.create(tmp_path / "run", config)
    assert tree(tmp_path) == []


def test_a_config_too_large_to_be_opened_again_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="allowed"):
        RunFolder.create(tmp_path / "run", {"x": "x" * (1 << 20)})
    assert tree(tmp_path) == []


HOSTILE = {
    "empty": b"",
    "half": b'{"format": "mbdpg-run", "ver',
    "no object": b"[1]",
    "foreign": b'{"name": "something else"}',
    "another format": b'{"format": "mbdpg-checkpoint", "version": 1, "run": {}}',
    "without a run": b'{"format": "mbdpg-run", "version": 1}',
    "run is a list": b'{"format": "mbdpg-run", "version": 1, "run": []}',
    "of the future": b'{"format": "mbdpg-run", "version": 2, "run": {}}',
    "strange version": b'{"format": "mbdpg-run", "version": "1\\u001b[2J\\n", "run": {}}',
    "deep": b"[" * 500_000,
    "long number": b'{"format": "mbdpg-run", "version": 1, "run": {"x": ' + b"9" * 100_000 + b"}}",
    "too large": b'{"format": "mbdpg-run", "version": 1, "run": {}}' + b" " * (1 << 20),
    "not text": b"\xff\xfe\x00",
    "pickle": b"cos\nsystem\n(S'touch somebody-ran-me'\ntR.",
}


@pytest.mark.parametrize("data", HOSTILE.values(), ids=HOSTILE.keys())
def test_what_is_not_a_run_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: bytes) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.json").write_bytes(data)
    with pytest.raises(UserError, match=r"config\.json") as caught:
        RunFolder.open(tmp_path)
    assert str(caught.value).isprintable()
    assert tree(tmp_path) == ["config.json"]


def test_a_folder_that_is_not_there_or_has_no_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a folder"):
        RunFolder.open(tmp_path / "nowhere")
    with pytest.raises(UserError, match=r"config\.json is missing"):
        RunFolder.open(tmp_path)


@pytest.mark.parametrize("part", ["config.json", "lock", "metrics.jsonl", "tensorboard", "checkpoints", "replay"])
def test_a_run_with_links_in_it_is_refused(tmp_path: Path, part: str) -> None:
    run, victim = RunFolder.create(tmp_path / "run", CONFIG), RunFolder.create(tmp_path / "victim", CONFIG)
    (run.path / part).unlink(missing_ok=True)
    (run.path / part).symlink_to(victim.path / part)
    with pytest.raises(UserError, match="is a link"):
        RunFolder.open(run.path)


HOLD_LOCK = """
import pathlib, sys
from mbdpg.storage.run_folder import RunFolder
with RunFolder.open(pathlib.Path(sys.argv[1])).locked():
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_is_refused_until_the_first_is_dead(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run", CONFIG)
    first = subprocess.Popen(
        [sys.executable, "-c", HOLD_LOCK, str(run.path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    with first:
        assert first.stdout
        assert first.stdout.readline() == b"locked\n"
        expected = f"in use by pid {first.pid} on host {re.escape(socket.gethostname())};"
        with pytest.raises(UserError, match=expected), run.locked():
            pytest.fail("two processes hold the lock")
        first.send_signal(signal.SIGKILL)
    (run.path / "lock").write_text("of a dead process, and longer than any other " * 9)
    with run.locked():
        assert (run.path / "lock").read_text() == f"pid {os.getpid()} on host {socket.gethostname()}"


def test_the_lock_is_given_back_also_after_an_error_which_stays_itself(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run", CONFIG)
    with pytest.raises(FileNotFoundError, match="of the run"), run.locked():
        raise FileNotFoundError("of the run")
    with run.locked(), pytest.raises(UserError, match="in use"), run.locked():
        pytest.fail("locked twice")


def test_a_lock_that_is_a_link_does_not_harm_its_target(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run", CONFIG)
    (tmp_path / "precious").write_text("precious")
    (run.path / "lock").symlink_to(tmp_path / "precious")
    with pytest.raises(UserError, match="cannot lock"), run.locked():
        pytest.fail("followed a link")
    assert (tmp_path / "precious").read_text() == "precious"


def test_nonsense_in_a_lock_file_does_not_reach_the_terminal(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run", CONFIG)
    with run.locked():
        (run.path / "lock").write_bytes(b"\x1b[2J\xff\n")
        with pytest.raises(UserError, match="in use by another process;"), run.locked():
            pytest.fail("locked twice")


def test_the_machine_is_described_in_json(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "--xla_test")
    machine = describe_machine()
    assert json.loads(json.dumps(machine)) == machine
    assert machine["XLA_FLAGS"] == "--xla_test"
    assert machine["cpu"]
    assert machine["cores"] >= 1
    assert machine["python"] == ".".join(map(str, sys.version_info[:3]))
    assert {"jax", "jaxlib", "numpy", "gymnasium", "mujoco"} <= {k for k, v in machine["versions"].items() if v}
