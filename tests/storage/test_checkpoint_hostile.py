"""All hashes are right in here, because the attacker computed them."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbdpg.interfaces import UserError
from mbdpg.storage.checkpoint import MAX_JSON_BYTES, CheckpointWriter, load_checkpoint
from mbdpg.storage.files import record_of
from mbdpg.storage.tensors import pack

MARKER = "somebody-ran-me"
PICKLE = b"cos\nsystem\n(S'touch " + MARKER.encode() + b"'\ntR."  # unpickling this runs `touch`


@pytest.fixture(autouse=True)
def no_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    """Syncing takes most of the time here and matters in a power cut only; test_checkpoint.py looks that it is done."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def run_at(folder: Path, env_steps: int) -> Path:
    folder.mkdir()
    replay = {"reward": np.arange(float(env_steps))}
    CheckpointWriter(folder).save(env_steps=env_steps, arrays={"x": np.ones(3)}, facts={}, replay=replay)
    return folder


def newest(run: Path) -> Path:
    return max((run / "checkpoints").iterdir())


def forge(run: Path, change: Callable[[dict[str, Any]], object]) -> None:
    manifest = newest(run) / "manifest.json"
    content = json.loads(manifest.read_text())
    change(content)
    manifest.write_text(json.dumps(content))


def forge_file(run: Path, name: str, data: bytes) -> None:
    (newest(run) / name).write_bytes(data)
    record = record_of(name, data)._asdict()
    forge(run, lambda manifest: manifest.update(files=[record if f["name"] == name else f for f in manifest["files"]]))


def assert_refused(run: Path, capsys: pytest.CaptureFixture[str], *parts: str) -> None:
    with pytest.raises(UserError, match="all 1 are damaged"):
        load_checkpoint(run)
    warning = capsys.readouterr().err
    assert warning.startswith("WARNING: skipping checkpoint 0")
    assert warning.count("\n") == 1
    assert warning.strip().isprintable()
    assert all(part in warning for part in parts)


@pytest.mark.parametrize("name", ["state.safetensors", "replay_tail.safetensors"])
def test_a_pickle_called_tensors_runs_nothing_and_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    run = run_at(tmp_path / "run", 100)
    forge_file(run, name, PICKLE)
    assert_refused(run, capsys, name)
    assert not Path(MARKER).exists()


HOSTILE_FACTS = {
    "pickle": PICKLE,
    "no object": b"[]",
    "deep": b"[" * 100_000,
    "long number": b'{"a": ' + b"1" * 9_999 + b"}",
    "not text": b"\xff\xfe",
    "large": b"{}" + b" " * MAX_JSON_BYTES,
}


@pytest.mark.parametrize("data", HOSTILE_FACTS.values(), ids=HOSTILE_FACTS.keys())
def test_hostile_facts_run_nothing_and_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], data: bytes
) -> None:
    monkeypatch.chdir(tmp_path)
    run = run_at(tmp_path / "run", 100)
    forge_file(run, "facts.json", data)
    assert_refused(run, capsys, "facts.json")
    assert not Path(MARKER).exists()


def rename_chunk(name: str) -> Callable[[dict[str, Any]], object]:
    return lambda manifest: manifest["chunks"][0].update(name=name)


HOSTILE_MANIFESTS: dict[str, Callable[[dict[str, Any]], object]] = {
    "a chunk above the run": rename_chunk("../../outside"),
    "a chunk at an absolute path": rename_chunk("/etc/passwd"),
    "a chunk with a control character": rename_chunk("000000-\x1b]0;\n.safetensors"),
    "a chunk of another place": rename_chunk(f"000001-{'0' * 16}.safetensors"),
    "a chunk in other digits": rename_chunk("\u0660" * 6 + "-" + "0" * 16 + ".safetensors"),
    "a million chunks": lambda manifest: manifest.update(chunks=manifest["chunks"] * 50_000),
    "a file above the checkpoint": lambda manifest: manifest["files"][0].update(name="../../outside"),
    "a file too many": lambda manifest: manifest["files"].append(manifest["files"][0]),
    "a file too few": lambda manifest: manifest["files"].pop(),
    "a size that is text": lambda manifest: manifest["files"][0].update(size="1"),
    "a hash that is null": lambda manifest: manifest["files"][0].update(sha256=None),
    "an unknown field": lambda manifest: manifest["files"][0].update(__class__="os.system"),
    "files that are no list": lambda manifest: manifest.update(files=1),
    "no chunks": lambda manifest: manifest.pop("chunks"),
    "another step": lambda manifest: manifest.update(env_steps=1),
    "another version": lambda manifest: manifest.update(version=2),
    "another format": lambda manifest: manifest.update(format="x" * 10_000),
}


@pytest.mark.parametrize("change", HOSTILE_MANIFESTS.values(), ids=HOSTILE_MANIFESTS.keys())
def test_a_hostile_manifest_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Callable[[dict[str, Any]], object]
) -> None:
    run = run_at(tmp_path / "run", 9_000)
    forge(run, change)
    assert_refused(run, capsys)


def test_a_manifest_or_file_beyond_its_cap_is_not_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("manifest.json", "facts.json", "state.safetensors"):
        run = run_at(tmp_path / name, 100)
        forge(run, lambda manifest, name=name: [f.update(size=1 << 40) for f in manifest["files"] if f["name"] == name])
        os.truncate(newest(run) / name, 1 << 40)  # takes no room on the disk, and all of the memory if read
        assert_refused(run, capsys, f"has {1 << 40} bytes")


def test_a_chunk_that_is_a_link_out_of_the_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_at(tmp_path / "run", 9_000)
    chunk = next((run / "replay").iterdir())
    chunk.rename(tmp_path / "outside")
    chunk.symlink_to(tmp_path / "outside")
    assert_refused(run, capsys, chunk.name)


def test_a_tail_that_claims_terabytes_allocates_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_at(tmp_path / "run", 9_000)
    forge_file(run, "replay_tail.safetensors", pack({"x": np.zeros((0, 1 << 40))}))
    assert_refused(run, capsys, "at least")


def test_a_tail_that_does_not_fit_its_chunks_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, tail in enumerate([{"x": np.zeros(3)}, {}, {"x": np.zeros(3), "y": np.zeros(4)}, {"x": np.zeros(())}]):
        run = run_at(tmp_path / str(number), 9_000)
        forge_file(run, "replay_tail.safetensors", pack(tail))
        assert_refused(run, capsys, "replay")


def test_a_checkpoint_that_is_a_link_is_no_checkpoint(tmp_path: Path) -> None:
    run, victim = run_at(tmp_path / "run", 100), run_at(tmp_path / "victim", 200)
    (run / "checkpoints" / "000000200").symlink_to(victim / "checkpoints" / "000000200")
    assert load_checkpoint(run).env_steps == 100
    CheckpointWriter(run, keep=1).save(env_steps=150, arrays={}, facts={}, replay={})
    assert load_checkpoint(victim).env_steps == 200
