import builtins
import contextlib
import errno
import functools
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbdpg.interfaces import UserError
from mbdpg.storage import replay_chunks
from mbdpg.storage.checkpoint import Checkpoint, CheckpointWriter, load_checkpoint
from mbdpg.storage.replay_chunks import CHUNK_ROWS
from mbdpg.storage.tensors import pack

ROOT = Path(__file__).resolve().parents[2]
DISK_CALLS = ("open", "mkdir", "fsync", "rename", "replace", "unlink", "rmdir")


@pytest.fixture(autouse=True)
def no_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    """Syncing takes most of a save's time and matters in a power cut only; one test looks that it is done."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def contents(env_steps: int, history: int = 0) -> dict[str, Any]:
    """What a run of `history` saves at a step: like a real one, its replay only grows."""
    arrays = {"actor/weight": np.full((4, 3), env_steps, np.float32), "counter": np.asarray(env_steps)}
    replay = {name: column[:env_steps] for name, column in experience(history).items()}
    return {"arrays": arrays, "facts": {"best": env_steps / 3, "history": history}, "replay": replay}


@functools.cache
def experience(history: int) -> dict[str, np.ndarray]:
    chance = np.random.default_rng(history)
    return {
        "observation": chance.normal(size=(40_000, 3)).astype(np.float32),
        "reward": chance.normal(size=40_000),
        "terminated": chance.random(40_000) < 0.1,
    }


def same(left: dict[str, np.ndarray], right: dict[str, np.ndarray]) -> bool:
    """Equal to the bit, NaN's payload and the sign of zero included."""
    return left.keys() == right.keys() and all(
        (left[k].dtype, left[k].shape, left[k].tobytes()) == (right[k].dtype, right[k].shape, right[k].tobytes())
        for k in left
    )


def is_whole(loaded: Checkpoint, history: int = 0) -> bool:
    saved = contents(loaded.env_steps, history)
    return (
        same(loaded.arrays, saved["arrays"]) and same(loaded.replay, saved["replay"]) and loaded.facts == saved["facts"]
    )


def run_with(folder: Path, *steps: int, keep: int = 2) -> Path:
    folder.mkdir()
    writer = CheckpointWriter(folder, keep=keep)
    for env_steps in steps:
        writer.save(env_steps=env_steps, **contents(env_steps))
    return folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def newest(run: Path) -> Path:
    return max((run / "checkpoints").iterdir())


# ── Exactness ─────────────────────────────────────────────────────────────────────────────────────────────────────────

INTEGERS = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"]
DTYPES = ["bool", *INTEGERS, "float16", "float32", "float64", "complex64"]


def layouts(array: np.ndarray) -> dict[str, np.ndarray]:
    padded = np.zeros((*array.shape[:-1], 2 * array.shape[-1]), array.dtype)
    padded[..., ::2] = array
    read_only = array.copy()
    read_only.flags.writeable = False
    return {
        "c": array,
        "fortran": np.asfortranarray(array),
        "transposed": array.T,
        "reversed": array[::-1],
        "strided": padded[..., ::2],
        "broadcast": np.broadcast_to(array[:1], array.shape),
        "read_only": read_only,
    }


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_dtype_rank_and_layout_comes_back_to_the_bit(tmp_path: Path, dtype: str) -> None:
    bits = np.random.default_rng(0).integers(0, 2 if dtype == "bool" else 256, size=6 * 64, dtype=np.uint8)
    array = bits.view(dtype)[: 2 * 3 * 4].reshape(2, 3, 4)
    arrays = {f"{name}/{layout}": view for name in ("x", "a b/é") for layout, view in layouts(array).items()}
    arrays |= {f"rank{rank}": np.ones((1,) * rank, dtype) for rank in range(6)}
    arrays |= {"empty": np.zeros((0, 3), dtype), "scalar": array[0, 0, 0]}
    CheckpointWriter(tmp_path).save(env_steps=0, arrays=arrays, facts={}, replay={"column": array.T, "odd": array.T})
    loaded = load_checkpoint(tmp_path)
    assert same(loaded.arrays, {name: np.asarray(value) for name, value in arrays.items()})
    assert same(loaded.replay, {"column": array.T, "odd": array.T})
    assert all(value.flags.writeable for value in (*loaded.arrays.values(), *loaded.replay.values()))


def test_facts_come_back_exactly(tmp_path: Path) -> None:
    floats = [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -0.0, float("inf"), float("nan")]
    facts = {"floats": floats, "big": 2**200, "text": "é\n\ud800", "none": None, "nested": {"yes": [True]}}
    CheckpointWriter(tmp_path).save(env_steps=0, arrays={}, facts=facts, replay={})
    assert repr(load_checkpoint(tmp_path).facts) == repr(facts)


@pytest.mark.parametrize("rows", [0, 1, CHUNK_ROWS - 1, CHUNK_ROWS, CHUNK_ROWS + 1, 2 * CHUNK_ROWS])
def test_replays_of_any_length_come_back(tmp_path: Path, rows: int) -> None:
    CheckpointWriter(tmp_path).save(env_steps=rows, **contents(rows))
    assert is_whole(load_checkpoint(tmp_path))


def test_what_is_loaded_can_be_saved_again_as_the_same_bytes(tmp_path: Path) -> None:
    run, again = run_with(tmp_path / "a", 20_000), run_with(tmp_path / "b")
    loaded = load_checkpoint(run)
    CheckpointWriter(again).save(env_steps=20_000, arrays=loaded.arrays, facts=loaded.facts, replay=loaded.replay)
    for path in filter(Path.is_file, run.rglob("*")):
        assert path.read_bytes() == (again / path.relative_to(run)).read_bytes()


# ── Chunks ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def identities(run: Path) -> dict[str, tuple[int, int, int]]:
    return {p.name: (s.st_ino, s.st_mtime_ns, s.st_ctime_ns) for p in (run / "replay").iterdir() if (s := p.stat())}


def test_a_chunk_is_written_once_also_by_the_next_process(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", 17_000)
    before = identities(run)
    assert len(before) == 2
    writer = CheckpointWriter(run)
    for env_steps in (17_500, 26_000, 34_000):
        writer.save(env_steps=env_steps, **contents(env_steps))
    after = identities(run)
    assert len(after) == 4
    assert before.items() <= after.items()


def test_rows_already_saved_are_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = CheckpointWriter(tmp_path)
    writer.save(env_steps=1, **contents(20_000))
    packed: list[int] = []
    monkeypatch.setattr(replay_chunks, "pack", lambda columns: packed.append(len(columns["reward"])) or pack(columns))
    writer.save(env_steps=2, **contents(20_100))
    assert not packed
    writer.save(env_steps=3, **contents(25_000))
    assert packed == [CHUNK_ROWS]


def test_two_histories_never_overwrite_each_others_rows(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", 100, 9_000)
    CheckpointWriter(run).save(env_steps=9_100, **contents(9_100, history=1))
    assert len(names(run / "replay")) == 2
    assert is_whole(load_checkpoint(run), history=1)
    shutil.rmtree(newest(run))
    assert is_whole(load_checkpoint(run))


def test_a_chunk_damaged_on_disk_is_healed_by_the_next_process(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", 9_000)
    next((run / "replay").iterdir()).write_bytes(b"rotten")
    CheckpointWriter(run).save(env_steps=9_100, **contents(9_100))
    assert is_whole(load_checkpoint(run))


def test_a_chunk_deleted_under_a_running_process_is_written_again(tmp_path: Path) -> None:
    writer = CheckpointWriter(tmp_path)
    writer.save(env_steps=17_000, **contents(17_000))
    min((tmp_path / "replay").iterdir()).unlink()
    writer.save(env_steps=17_100, **contents(17_100))
    assert is_whole(load_checkpoint(tmp_path))


def test_a_replay_that_shrank_or_changed_its_columns_is_refused(tmp_path: Path) -> None:
    writer = CheckpointWriter(tmp_path)
    writer.save(env_steps=9_000, **contents(9_000))
    with pytest.raises(ValueError, match="only grow"):
        writer.save(env_steps=9_100, **contents(100))
    changed = contents(9_100)
    changed["replay"]["reward"] = changed["replay"]["reward"].astype(np.float32)
    with pytest.raises(ValueError, match="columns changed"):
        writer.save(env_steps=9_100, **changed)
    assert load_checkpoint(tmp_path).env_steps == 9_000


def test_columns_of_different_length_are_refused(tmp_path: Path) -> None:
    for replay in ({"a": np.zeros(2), "b": np.zeros(3)}, {"a": np.zeros(())}):
        with pytest.raises(ValueError, match="different length"):
            CheckpointWriter(tmp_path).save(env_steps=0, arrays={}, facts={}, replay=replay)


def test_neither_saving_nor_loading_copies_the_replay(tmp_path: Path) -> None:
    replay = {"observation": np.ones((40 * CHUNK_ROWS + 5, 16), np.float32)}
    total, chunk = replay["observation"].nbytes, 16 * 4 * CHUNK_ROWS
    tracemalloc.start()
    CheckpointWriter(tmp_path).save(env_steps=0, arrays={}, facts={}, replay=replay)
    saving = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    load_checkpoint(tmp_path)
    loading = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert saving < 6 * chunk
    assert total < loading < total + 6 * chunk


# ── What is kept ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_only_the_newest_are_kept_with_the_chunks_they_name(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", 9_000, 10_000, 17_000, keep=2)
    assert names(run / "checkpoints") == ["000010000", "000017000"]
    stray = run / "replay" / f"000000-{'0' * 16}.safetensors"
    stray.write_bytes(b"of a history that this run has left")
    (run / "checkpoints" / ".tmp-000000005").mkdir()
    (run / "replay" / ".tmp-x").write_bytes(b"half")
    path = CheckpointWriter(run, keep=1).save(env_steps=26_000, **contents(26_000))
    assert path == run / "checkpoints" / "000026000"
    assert names(run / "checkpoints") == ["000026000"]
    assert [name[:6] for name in names(run / "replay")] == ["000000", "000001", "000002"]
    assert not stray.exists()
    assert is_whole(load_checkpoint(run))


def test_saving_a_step_again_replaces_it(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", 100, 9_000)
    CheckpointWriter(run).save(env_steps=9_000, **contents(9_000, history=1))
    assert names(run / "checkpoints") == ["000000100", "000009000"]
    assert is_whole(load_checkpoint(run), history=1)


def test_going_on_from_an_older_checkpoint_buries_the_damaged_future(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", 100, 300)
    (newest(run) / "state.safetensors").unlink()
    assert load_checkpoint(run).env_steps == 100
    CheckpointWriter(run, keep=1).save(env_steps=200, **contents(200))
    assert names(run / "checkpoints") == ["000000200"]
    assert is_whole(load_checkpoint(run))


def test_no_checkpoint_is_a_users_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="none was saved yet"):
        load_checkpoint(tmp_path)


def test_steps_beyond_nine_digits_are_still_the_newest(tmp_path: Path) -> None:
    writer = CheckpointWriter(tmp_path)
    for env_steps in (999_999_999, 1_000_000_000):
        writer.save(env_steps=env_steps, arrays={}, facts={}, replay={})
    assert load_checkpoint(tmp_path).env_steps == 1_000_000_000


# ── Death and failure in the middle of a save ─────────────────────────────────────────────────────────────────────────


@contextlib.contextmanager
def disk_calls(act: Callable[[int], None]) -> Iterator[None]:
    """Call `act(number)` before each call that changes the disk, and each that opens a file."""
    number = 0
    originals: dict[Any, Any] = {(os, name): getattr(os, name) for name in DISK_CALLS}
    originals[builtins, "open"] = builtins.open

    def watched(original: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal number
            number += 1
            act(number)
            return original(*args, **kwargs)

        return call

    try:
        for (module, name), original in originals.items():
            setattr(module, name, watched(original))
        yield
    finally:
        for (module, name), original in originals.items():
            setattr(module, name, original)


SCENARIOS = [(26_000, 2), (17_000, 1)]
"""(env_steps, keep) of a save after one at 17 000: a new step, and a replacement of the only checkpoint."""


def check_survivor(run: Path, env_steps: int, keep: int) -> None:
    """A whole checkpoint is there, not older than the last; and the next save finds nothing in its way."""
    for path in (run / "checkpoints").glob("0*"):
        assert len(names(path)) == 4, "half of a checkpoint is in sight"
    loaded = load_checkpoint(run)
    assert loaded.env_steps in (17_000, env_steps)
    assert is_whole(loaded)
    CheckpointWriter(run, keep=keep).save(env_steps=env_steps, **contents(env_steps))
    assert is_whole(load_checkpoint(run))
    assert newest(run).name == f"{env_steps:09d}"
    assert len(names(run / "checkpoints")) == keep
    assert len(names(run / "replay")) == env_steps // CHUNK_ROWS


def die_at_every_call(folder: Path, env_steps: int, keep: int) -> int:
    """Kill a save before its first, second, … disk call, until one gets through; return how many died."""
    os.fsync = lambda descriptor: None  # as no_sync; this process runs nothing else
    template = run_with(folder / "template", 9_000, 17_000, keep=keep)
    for deadly in range(1, 1000):
        run = shutil.copytree(template, folder / "run")
        child = os.fork()
        if child == 0:
            with disk_calls(lambda number, deadly=deadly: os._exit(9) if number == deadly else None):
                CheckpointWriter(run, keep=keep).save(env_steps=env_steps, **contents(env_steps))
            os._exit(0)
        _, status = os.waitpid(child, 0)
        check_survivor(run, env_steps, keep)
        shutil.rmtree(run)
        if status == 0:
            return deadly - 1
    raise AssertionError("the save never got through")


def die_at_random_times(folder: Path, deaths: int) -> int:
    """Kill -9 a process that saves in a loop, again and again; return the last step reached."""
    run = run_with(folder / "run", 1_000)
    chance = random.Random(0)
    last = 1_000
    for _ in range(deaths):
        child = os.fork()
        if child == 0:
            start = load_checkpoint(run).env_steps
            writer = CheckpointWriter(run)
            for env_steps in range(start + 100, 40_000, 100):
                writer.save(env_steps=env_steps, **contents(env_steps))
            os._exit(0)
        time.sleep(chance.uniform(0.02, 0.12))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        loaded = load_checkpoint(run)
        assert loaded.env_steps >= last
        assert is_whole(loaded)
        last = loaded.env_steps
    return last


WITHOUT_JAX = f"""
import pathlib, sys, types
sys.modules["mbdpg"] = types.ModuleType("mbdpg")  # not mbdpg/__init__.py, which imports JAX
sys.modules["mbdpg"].__path__ = [{str(ROOT / "mbdpg")!r}]
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_checkpoint
assert "jax" not in sys.modules
"""


def in_own_process(call: str, folder: Path) -> str:
    """Call one of this file's functions where forking is safe: in a process without JAX and its threads."""
    code = f"{WITHOUT_JAX}print(test_checkpoint.{call.format(folder=f'pathlib.Path({str(folder)!r})')})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.strip()


@pytest.mark.parametrize(("env_steps", "keep"), SCENARIOS)
def test_killed_before_any_disk_call_of_a_save_a_whole_checkpoint_remains(
    tmp_path: Path, env_steps: int, keep: int
) -> None:
    assert int(in_own_process(f"die_at_every_call({{folder}}, {env_steps}, {keep})", tmp_path)) > 25


def test_killed_at_random_times_a_whole_checkpoint_remains(tmp_path: Path) -> None:
    assert int(in_own_process("die_at_random_times({folder}, 20)", tmp_path)) > 1_000


@pytest.mark.parametrize("lasting", [False, True], ids=["one call fails", "all later calls fail"])
@pytest.mark.parametrize(("env_steps", "keep"), SCENARIOS)
def test_whichever_disk_call_fails_a_whole_checkpoint_remains(
    tmp_path: Path, env_steps: int, keep: int, lasting: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    template = run_with(tmp_path / "template", 9_000, 17_000, keep=keep)
    failures = 0
    for failing in range(1, 1000):
        run = shutil.copytree(template, tmp_path / "run")
        failed = False

        def fail(number: int, failing: int = failing) -> None:
            nonlocal failed
            if number == failing or (lasting and number > failing):
                failed = True
                raise OSError(errno.EIO, os.strerror(errno.EIO))

        with disk_calls(fail):
            try:
                CheckpointWriter(run, keep=keep).save(env_steps=env_steps, **contents(env_steps))
                saved = True
            except UserError as error:
                saved = False
                message = str(error)
        if saved:
            assert load_checkpoint(run).env_steps == env_steps
        else:
            failures += 1
            assert "MB are needed; the last checkpoint (step" in message
            assert "\n" not in message
        check_survivor(run, env_steps, keep)
        shutil.rmtree(run)
        if not failed:
            break
    assert failures > 15
    assert "skipping" not in capsys.readouterr().err


def test_everything_is_on_the_disk_before_the_name_that_promises_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_with(tmp_path / "run", 100)
    synced: list[str] = []
    done: list[tuple[str, set[str]]] = []
    rename = os.rename

    def note(source: Path, target: Path) -> None:
        done.append((target.name, set(synced)))
        rename(source, target)

    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.readlink(f"/proc/self/fd/{descriptor}")))
    monkeypatch.setattr(os, "rename", note)
    monkeypatch.setattr(os, "replace", note)
    path = CheckpointWriter(run).save(env_steps=9_000, **contents(9_000))
    chunk = names(run / "replay")[0]
    (first, before_chunk), (second, before_checkpoint) = done
    assert (first, second) == (chunk, path.name)
    assert f"{run}/replay/.tmp-{chunk}" in before_chunk
    beside = f"{run}/checkpoints/.tmp-{path.name}"
    assert before_checkpoint - before_chunk == {f"{run}/replay", beside, *(f"{beside}/{n}" for n in names(path))}
    assert synced[0] == str(run)
    assert synced[-1] == f"{run}/checkpoints"


def test_the_same_writer_goes_on_after_a_failure(tmp_path: Path) -> None:
    writer = CheckpointWriter(tmp_path)
    writer.save(env_steps=9_000, **contents(9_000))

    def fail(number: int) -> None:
        if number > 14:  # in the middle of the third chunk or so
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with disk_calls(fail), pytest.raises(UserError):
        writer.save(env_steps=39_000, **contents(39_000))
    writer.save(env_steps=39_500, **contents(39_500))
    assert is_whole(load_checkpoint(tmp_path))


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS])
def test_a_disk_that_refuses_is_a_users_error_with_room_needed_and_what_is_left(tmp_path: Path, code: int) -> None:
    run = run_with(tmp_path / "run", 9_000)

    def fail(number: int) -> None:
        raise OSError(code, os.strerror(code))

    needed = 26_000 * (3 * 4 + 8 + 1) / 1e6  # a new process cannot know that a chunk of it is there
    with disk_calls(fail), pytest.raises(UserError) as caught:
        CheckpointWriter(run).save(env_steps=26_000, **contents(26_000))
    assert os.strerror(code) in str(caught.value)
    assert f"{needed:.1f} MB are needed; the last checkpoint (step 9000) is intact" in str(caught.value)


def check_full_disk(run: Path) -> None:
    """A save that does not fit leaves the last one intact and nothing half-written; one that fits gets through."""
    files = names(run / "checkpoints")
    too_much = contents(200) | {"arrays": {"large": np.random.default_rng(0).normal(size=500_000)}}
    with pytest.raises(UserError, match=r"4\.0 MB are needed; the last checkpoint \(step 100\) is intact"):
        CheckpointWriter(run).save(env_steps=200, **too_much)
    assert names(run / "checkpoints") == files
    assert is_whole(load_checkpoint(run))
    CheckpointWriter(run).save(env_steps=200, **contents(200))
    assert is_whole(load_checkpoint(run))


def test_a_write_that_stops_half_way_leaves_the_last_checkpoint_intact(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", 100)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, limits[1]))  # the kernel refuses at one megabyte
    try:
        check_full_disk(run)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_leaves_the_last_checkpoint_intact(tmp_path: Path) -> None:
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(tmp_path)], capture_output=True)
    if mount.returncode:
        pytest.skip("only root may mount a small disk; the test above does not need one")
    try:
        check_full_disk(run_with(tmp_path / "run", 100))
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


# ── Damage ────────────────────────────────────────────────────────────────────────────────────────────────────────────

DAMAGES: dict[str, Callable[[Path], object]] = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "extended": lambda path: path.write_bytes(path.read_bytes() + b"\0"),
    "flipped": lambda path: path.write_bytes(path.read_bytes()[:-9] + bytes([path.read_bytes()[-9] ^ 1])),
    "flipped, same size": lambda path: path.write_bytes(bytes([path.read_bytes()[0] ^ 1]) + path.read_bytes()[1:]),
    "emptied": lambda path: path.write_bytes(b""),
    "deleted": lambda path: path.unlink(),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "a link": lambda path: (path.rename(path.with_suffix(".x")), path.symlink_to(path.with_suffix(".x"))),
    "a named pipe": lambda path: (path.unlink(), os.mkfifo(path)),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize(
    "file", ["manifest.json", "state.safetensors", "facts.json", "replay_tail.safetensors", "chunk"]
)
def test_a_damaged_checkpoint_is_skipped_loudly(
    tmp_path: Path, file: str, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_with(tmp_path / "run", 9_000, 17_000)
    path = max((run / "replay").iterdir()) if file == "chunk" else newest(run) / file
    DAMAGES[damage](path)
    loaded = load_checkpoint(run)
    assert loaded.env_steps == 9_000
    assert is_whole(loaded)
    assert_one_line(capsys.readouterr().err, path.name)


def assert_one_line(text: str, *parts: str) -> None:
    assert text.count("\n") == 1
    assert text.startswith("WARNING: skipping checkpoint 0")
    assert all(part in text for part in parts)
    assert text.strip().isprintable()


def test_no_flipped_bit_of_a_manifest_gives_wrong_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(replay_chunks, "CHUNK_ROWS", 4)
    run = run_with(tmp_path / "run", 5, 9)
    manifest = newest(run) / "manifest.json"
    good = manifest.read_bytes()
    fallbacks = 0
    positions = range(0, len(good), 3)
    for position in positions:
        flipped = bytearray(good)
        flipped[position] ^= 1 << position % 8
        manifest.write_bytes(flipped)
        loaded = load_checkpoint(run)
        assert is_whole(loaded)
        fallbacks += loaded.env_steps == 5
    assert fallbacks > 0.9 * len(positions)
    assert capsys.readouterr().err.count("\n") == fallbacks


def test_when_all_are_damaged_it_is_a_users_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_with(tmp_path / "run", 100, 200)
    for path in (run / "checkpoints").iterdir():
        (path / "facts.json").unlink()
    with pytest.raises(UserError, match="all 2 are damaged"):
        load_checkpoint(run)
    assert capsys.readouterr().err.count("WARNING") == 2
