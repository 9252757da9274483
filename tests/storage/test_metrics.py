import json
import math
import os
import random
import resource
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tensorboardX
from tensorboardX.proto.event_pb2 import Event, SessionLog

from mbdpg.interfaces import UserError
from mbdpg.storage.metrics import MetricsLog, Value, read_metrics

FILES = ("metrics.jsonl", "timings.jsonl")


@pytest.fixture(autouse=True)
def no_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    """Syncing takes most of the time here and matters in a power cut only; one test looks that it is done."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def lines(folder: Path, name: str) -> list[str]:
    return (folder / name).read_text().splitlines()


def append(path: Path, data: bytes) -> None:
    with path.open("ab") as file:
        file.write(data)


def play(log: MetricsLog, start: int, stop: int) -> None:
    """What a run records between two steps: two kinds of row, each a function of its step."""
    for env_steps in range(start, stop):
        log.write("train", env_steps, {"train/episode_return": env_steps / 3, "time/seconds": random.random()})
        if env_steps % 5 == 0:
            log.write("eval", env_steps, {"eval/returns": [env_steps / 7, -0.0], "eval/return_mean": env_steps})


def events(folder: Path) -> list[Event]:
    """Every event in the order in which TensorBoard reads them."""
    found = []
    for path in sorted((folder / "tensorboard").iterdir(), key=lambda path: path.name.rpartition(".")[2]):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("Q", data[:8])
            found.append(Event.FromString(data[12 : 12 + length]))
            data = data[16 + length :]
    return found


def scalars(folder: Path) -> list[tuple[int, str, float]]:
    return [(event.step, value.tag, value.simple_value) for event in events(folder) for value in event.summary.value]


# ── Rows ──────────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_row_is_one_line_and_times_go_elsewhere(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        log.write("train", 5, {"critic/loss": 0.1, "time/acting": 2.5, "note": "x\ny"})
        log.write("eval", 5, {"eval/returns": [1.0, 2.0]})
        log.write("clock", 5, {"time/seconds": 1})
    assert lines(tmp_path, "metrics.jsonl") == [
        '{"kind": "train", "env_steps": 5, "critic/loss": 0.1, "note": "x\\ny"}',
        '{"kind": "eval", "env_steps": 5, "eval/returns": [1.0, 2.0]}',
    ]
    assert lines(tmp_path, "timings.jsonl") == [
        '{"kind": "train", "env_steps": 5, "time/acting": 2.5}',
        '{"kind": "clock", "env_steps": 5, "time/seconds": 1}',
    ]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (0.1 + 0.2, 0.1 + 0.2),
        (5e-324, 5e-324),
        (np.float32(0.1), float(np.float32(0.1))),
        (np.float64(1 / 3), 1 / 3),
        (np.int64(2**62), 2**62),
        (np.asarray(1.5, np.float32), 1.5),
        (np.asarray([[1, 2]]), [[1, 2]]),
        (2**53 + 1, 2**53 + 1),
        (True, True),
        (float("nan"), None),
        (np.float32("inf"), None),
        ([1.0, float("-inf"), np.nan], [1.0, None, None]),
        ("nan", "nan"),
        ([], []),
    ],
)
def test_values_come_back_exactly_and_what_is_not_finite_as_none(
    tmp_path: Path, value: Value, expected: object
) -> None:
    with MetricsLog(tmp_path) as log:
        log.write("train", 0, {"x": value})
    (got,) = read_metrics(tmp_path, "train")["x"]
    assert (type(got), got) == (type(expected), expected)
    json.loads((tmp_path / "metrics.jsonl").read_text(), parse_constant=pytest.fail)  # strict JSON has no NaN


def test_the_steps_of_a_kind_increase_strictly(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        log.write("train", 5, {"x": 1})
        log.write("eval", 0, {"x": 1})
        for env_steps in (5, 4):
            with pytest.raises(ValueError, match="a row at 5"):
                log.write("train", env_steps, {"x": 1})
        with pytest.raises(ValueError, match="arguments"):
            log.write("train", 6, {"kind": "eval"})
        log.write("train", 6, {"x": 1})
    assert len(lines(tmp_path, "metrics.jsonl")) == 3


def test_rows_are_read_as_columns(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        log.write("train", 1, {"a": 1.0, "time/seconds": 0.5})
        log.write("eval", 1, {"a": 9.0})
        log.write("train", 3, {"b": "x"})
        log.write("train", 7, {"time/seconds": 0.25})
    assert read_metrics(tmp_path, "train") == {
        "env_steps": [1, 3, 7],
        "a": [1.0, None, None],
        "b": [None, "x", None],
        "time/seconds": [0.5, None, 0.25],
    }
    assert read_metrics(tmp_path, "unknown") == {"env_steps": []}


def test_rows_can_be_read_while_the_run_goes_on(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path)
    log.write("train", 1, {"a": 1.0})
    append(tmp_path / "metrics.jsonl", b'{"kind": "train", "env_st')
    assert read_metrics(tmp_path, "train") == {"env_steps": [1], "a": [1.0]}
    log.close()


@pytest.mark.parametrize("row", ["rubbish", "[]", '{"kind": 1, "env_steps": 1}', '{"kind": "train"}', "[" * 99_999])
def test_a_damaged_row_is_named(tmp_path: Path, row: str) -> None:
    (tmp_path / "metrics.jsonl").write_text(f'{{"kind": "train", "env_steps": 1}}\n{row}\n')
    with pytest.raises(UserError, match="line 2 of"):
        read_metrics(tmp_path, "train")


def test_a_folder_without_metrics_is_a_users_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no metrics\.jsonl"):
        read_metrics(tmp_path, "train")
    with pytest.raises(UserError, match="cannot write metrics"):
        MetricsLog(tmp_path / "nowhere")


# ── Resuming ──────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("seed", range(5))
def test_a_run_killed_twenty_times_has_the_bytes_of_one_that_was_not(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    with MetricsLog(tmp_path / "whole") as log:
        play(log, 0, 300)

    run, step, saved = tmp_path / "killed", 0, {"metrics.jsonl": 0, "timings.jsonl": 0}
    for _ in range(20):
        log = MetricsLog(run, offsets=saved)
        reached = min(step + chance.randrange(30), 290)
        play(log, step, reached)
        step, saved = reached, log.offsets()
        play(log, step, min(step + chance.randrange(20), 300))
        log.close()
        for name in FILES:  # the kill came in the middle of a row
            append(run / name, b'{"kind": "train", "env_steps": 123456'[: chance.randrange(38)])
    with MetricsLog(run, offsets=saved) as log:
        play(log, step, 300)

    assert (run / "metrics.jsonl").read_bytes() == (tmp_path / "whole" / "metrics.jsonl").read_bytes()
    assert read_metrics(run, "train")["env_steps"] == list(range(300))
    assert None not in read_metrics(run, "train")["time/seconds"]


def test_the_last_step_of_a_kind_is_known_after_resuming(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        log.write("train", 5, {"x": 1})
        log.write("clock", 7, {"time/seconds": 1})
        offsets = log.offsets()
        log.write("train", 9, {"x": 1})
    with MetricsLog(tmp_path, offsets=offsets) as log:
        for kind, env_steps in (("train", 5), ("clock", 7)):
            with pytest.raises(ValueError, match="already"):
                log.write(kind, env_steps, {"x": 1})
        log.write("train", 6, {"x": 1})
    assert read_metrics(tmp_path, "train")["env_steps"] == [5, 6]


def test_a_checkpoint_counts_only_on_rows_that_are_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.readlink(f"/proc/self/fd/{descriptor}")))
    with MetricsLog(tmp_path) as log:
        log.write("train", 5, {"note": "x"})
        assert log.offsets() == {name: (tmp_path / name).stat().st_size for name in FILES}
    assert synced == [str(tmp_path / name) for name in FILES]


def test_a_new_log_does_not_run_into_an_old_one(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        log.write("train", 5, {"x": 1})
    with pytest.raises(UserError, match="has rows already"):
        MetricsLog(tmp_path)


@pytest.mark.parametrize(
    "change",
    [{"metrics.jsonl": 10**6}, {"metrics.jsonl": 7}, {"timings.jsonl": -1}, {"timings.jsonl": None}]
    + [{"metrics.jsonl": value} for value in (True, 1.0, "1", [])],
    ids=str,
)
def test_a_record_that_does_not_fit_the_checkpoint_is_refused_and_left_alone(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    with MetricsLog(tmp_path) as log:
        play(log, 0, 10)
        offsets: dict[str, Any] = log.offsets()
        play(log, 10, 12)
    before = [(tmp_path / name).read_bytes() for name in FILES]
    with pytest.raises(UserError, match="cannot resume"):
        MetricsLog(tmp_path, offsets=offsets | change)
    assert [(tmp_path / name).read_bytes() for name in FILES] == before


def test_a_row_damaged_before_the_checkpoint_is_named(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_bytes(b"rubbish\n")
    with pytest.raises(UserError, match="cannot resume: line 1 of"):
        MetricsLog(tmp_path, offsets={"metrics.jsonl": 8, "timings.jsonl": 0})


# ── Full disks ────────────────────────────────────────────────────────────────────────────────────────────────────────


def write_notes(log: MetricsLog) -> None:
    for env_steps in range(1000):
        log.write("train", env_steps, {"note": "x" * 31})


def test_a_full_disk_leaves_no_part_of_a_row(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, limits[1]))  # the kernel refuses beyond the thousandth byte
    try:
        with pytest.raises(UserError, match="cannot write metrics"):
            write_notes(log)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    rows = lines(tmp_path, "metrics.jsonl")
    assert len(rows) > 5
    assert log.offsets()["metrics.jsonl"] == sum(len(row) + 1 for row in rows)
    log.write("train", len(rows), {"note": "there is room again"})
    log.close()
    assert read_metrics(tmp_path, "train")["env_steps"] == list(range(len(rows) + 1))


# ── TensorBoard ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_tensorboard_gets_the_scalars_at_their_step(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        assert not (tmp_path / "tensorboard").exists()
        log.write("train", 5, {"a": 1.5, "time/s": 2, "list": [1.0], "text": "x", "nan": math.nan})
        log.write("eval", 5, {"list": [1.0]})
        log.write("train", 2**40, {"a": np.float32(2.5)})
    assert scalars(tmp_path) == [(5, "a", 1.5), (5, "time/s", 2.0), (2**40, "a", 2.5)]
    assert events(tmp_path)[0].file_version == "brain.Event:2"


def test_a_resumed_run_hides_the_events_it_will_write_again(tmp_path: Path) -> None:
    with MetricsLog(tmp_path) as log:
        log.write("train", 5, {"a": 1.0})
        offsets = log.offsets()
        log.write("train", 9, {"a": 2.0})
    with MetricsLog(tmp_path, offsets=offsets) as log:
        log.write("train", 9, {"a": 2.0})
    assert len(list((tmp_path / "tensorboard").iterdir())) == 2  # though within the same second
    (purge,) = [event for event in events(tmp_path) if event.HasField("session_log")]
    assert (purge.session_log.status, purge.step) == (SessionLog.START, 6)
    assert scalars(tmp_path) == [(5, "a", 1.0), (9, "a", 2.0), (9, "a", 2.0)]


@pytest.mark.parametrize("broken", ["open", "write", "flush"])
def test_a_failing_tensorboard_is_dropped_with_one_line_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], broken: str
) -> None:
    def fail(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tensorboardX.RecordWriter, "__init__" if broken == "open" else broken, fail)
    with MetricsLog(tmp_path) as log:
        for env_steps in range(50):
            log.write("train", env_steps, {"a": 1.0})
            log.offsets()
    warning = capsys.readouterr().err
    assert warning.count("\n") == 1
    assert "No space left on device" in warning
    assert len(read_metrics(tmp_path, "train")["a"]) == 50


def test_a_full_disk_under_tensorboard_does_not_hang_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tensorboardX.record_writer.open_file", lambda path: open("/dev/full", "wb"))  # noqa: SIM115
    with MetricsLog(tmp_path) as log:
        for env_steps in range(1000):
            log.write("train", env_steps, {"a": 1.0})
    assert capsys.readouterr().err.count("\n") == 1
    assert len(read_metrics(tmp_path, "train")["a"]) == 1000
