"""The rows that a run records as it goes, in a form that no restart can duplicate, lose or tear.

`metrics.jsonl` holds only what is a function of the run's config, so a run that was killed and resumed has the same
bytes in it as one that was not. What differs every time, the names under `time/`, goes to `timings.jsonl`. Both go to
TensorBoard as well.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import socket
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, final

import numpy as np

from mbdpg.interfaces import UserError
from mbdpg.storage.files import DamagedFileError, parse_object

Value = float | int | str | Sequence[float] | np.ndarray | np.generic

_METRICS, _TIMINGS = _FILES = ("metrics.jsonl", "timings.jsonl")
_TENSORBOARD_FLUSH_SECONDS = 30.0


@final
class MetricsLog:
    """The open record of one run, whose lock the caller holds. Close it, or use it in a `with` block."""

    def __init__(self, folder: Path, *, offsets: Mapping[str, Any] | None = None) -> None:
        """Begin the record in the run folder `folder`, or go on where `offsets()` once said (bytes by file name).

        Going on cuts off everything later, a half-written row included.

        Raises:
            UserError: there is a record already and no `offsets`; or it is shorter than `offsets` or damaged.
        """
        self._files: dict[str, BinaryIO] = {}
        self._last: dict[str, int] = {}
        try:
            starts = _check_starts(folder, offsets)
            for name, start in starts.items():
                file = open(folder / name, "ab", buffering=0)  # noqa: SIM115 - open as long as the run is
                self._files[name] = file
                file.truncate(start)
            for name in starts:
                for row in _read_rows(folder / name):
                    self._last[row["kind"]] = max(row["env_steps"], self._last.get(row["kind"], -1))
        except DamagedFileError as damage:
            self._close_files()
            raise UserError(f"cannot resume: {damage}") from damage
        except OSError as error:
            self._close_files()
            raise UserError(f"cannot write metrics in {folder}: {error.strerror}") from error
        after = None if offsets is None else max(self._last.values(), default=-1)
        self._events = _EventFile(folder / "tensorboard", after=after)

    def write(self, kind: str, env_steps: int, values: Mapping[str, Value]) -> None:
        """Record one row of `kind` ("train", "eval", …) at `env_steps`, larger than at the last row of that kind.

        Numbers, strings and lists come back exactly from `read_metrics`; NaN and infinities as None.

        Raises:
            UserError: the disk is full or not writable; no part of a row is left in the file.
            ValueError: `env_steps` did not increase, or a value is called "kind" or "env_steps".
        """
        if env_steps <= self._last.get(kind, -1):
            raise ValueError(f"{kind!r} has a row at {self._last[kind]} env_steps already, so none at {env_steps}")
        if not values.keys().isdisjoint({"kind", "env_steps"}):
            raise ValueError("'kind' and 'env_steps' are arguments, not values")
        plain = {name: _plain(value) for name, value in values.items()}
        rows: dict[str, dict[str, Any]] = {_METRICS: {}, _TIMINGS: {}}
        for name, value in plain.items():
            rows[_TIMINGS if name.startswith("time/") else _METRICS][name] = value
        for name, row in rows.items():
            if row:
                line = json.dumps({"kind": kind, "env_steps": env_steps, **row}, allow_nan=False) + "\n"
                _append(self._files[name], line.encode())
        self._last[kind] = env_steps
        self._events.add(env_steps, {name: v for name, v in plain.items() if isinstance(v, (int, float))})

    def offsets(self) -> dict[str, int]:
        """Return each file's length in bytes once all of it is on the disk: a checkpoint's share of this record.

        Raises:
            UserError: the disk refuses.
        """
        self._events.flush()
        try:
            for file in self._files.values():
                os.fsync(file.fileno())
            return {name: os.fstat(file.fileno()).st_size for name, file in self._files.items()}
        except OSError as error:
            raise UserError(f"cannot write metrics: {error.strerror}; make room, then resume") from error

    def close(self) -> None:
        """Close the files; rows are on their way to the disk already."""
        self._events.close()
        self._close_files()

    def _close_files(self) -> None:
        for file in self._files.values():
            file.close()

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(self, *reason: object) -> None:
        self.close()


def read_metrics(folder: Path, kind: str) -> dict[str, list[Any]]:
    """Return the rows of `kind` in the run folder as columns of equal length, by increasing "env_steps".

    Metrics and timings of a step are one row; None stands where a row lacks a name. The run may still be going on: a
    half-written last row is left out.

    Raises:
        UserError: there is no record, or a row is damaged.
    """
    if not (folder / _METRICS).is_file():
        raise UserError(f"{folder} has no {_METRICS}; expected the folder of a run")
    rows: dict[int, dict[str, Any]] = {}
    try:
        for name in _FILES:
            for row in _read_rows(folder / name):
                if row.pop("kind") == kind:
                    rows.setdefault(row["env_steps"], {}).update(row)
    except DamagedFileError as damage:
        raise UserError(f"cannot read metrics: {damage}") from damage
    names = dict.fromkeys(["env_steps", *(name for row in rows.values() for name in row)])
    return {name: [rows[step].get(name) for step in sorted(rows)] for name in names}


@final
class _EventFile:
    """TensorBoard's copy of the scalars, which may fail without harm to the run.

    Not tensorboardX's SummaryWriter: its thread dies when the disk is full, and the eleventh scalar after that waits
    for ever.
    """

    def __init__(self, folder: Path, *, after: int | None) -> None:
        """Write into `folder` when there is something to write, hiding older events beyond the step `after`."""
        self._folder = folder
        self._after = after
        self._writer: Any = None
        self._failed = False
        self._flushed = time.monotonic()

    def add(self, env_steps: int, scalars: Mapping[str, float | int]) -> None:
        if self._failed or not scalars:
            return
        try:
            from tensorboardX.proto.event_pb2 import Event
            from tensorboardX.proto.summary_pb2 import Summary

            if self._writer is None:
                self._open()
            summary = Summary(value=[Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()])
            event = Event(wall_time=time.time(), step=env_steps, summary=summary)
            self._writer.write(event.SerializeToString())
        except Exception as error:  # whatever goes wrong in there, training goes on
            self._drop(error)
        if time.monotonic() - self._flushed > _TENSORBOARD_FLUSH_SECONDS:
            self.flush()

    def flush(self) -> None:
        self._flushed = time.monotonic()
        if self._writer is not None:
            try:
                self._writer.flush()
            except Exception as error:
                self._drop(error)

    def close(self) -> None:
        self.flush()
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _open(self) -> None:
        from tensorboardX import RecordWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self._folder.mkdir(exist_ok=True)
        # Numbered: a run resumed within the second must not overwrite its own events.
        number = len(list(self._folder.iterdir()))
        name = f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{number:04d}"
        self._writer = RecordWriter(str(self._folder / name))
        self._writer.write(Event(wall_time=time.time(), file_version="brain.Event:2").SerializeToString())
        if self._after is not None:
            start = SessionLog(status=SessionLog.START)
            event = Event(wall_time=time.time(), step=self._after + 1, session_log=start)
            self._writer.write(event.SerializeToString())

    def _drop(self, error: Exception) -> None:
        print(f"WARNING: no more TensorBoard events: {error}; metrics are still in {_METRICS}", file=sys.stderr)
        self._failed = True
        with contextlib.suppress(Exception):
            self._writer.close()
        self._writer = None


def _check_starts(folder: Path, offsets: Mapping[str, Any] | None) -> dict[str, int]:
    """Return where each file is to be cut, having looked that it can be: only at the end of one of its rows."""
    starts = {}
    for name in _FILES:
        path = folder / name
        size = path.stat().st_size if path.is_file() else 0
        start = 0 if offsets is None else offsets.get(name)
        if offsets is None and size > 0:
            raise UserError(f"{path} has rows already; resume the run or choose another --out")
        if type(start) is not int or not 0 <= start <= size:
            raise UserError(
                f"cannot resume: {path} has {size} bytes, but the checkpoint was saved at {start!r}; put the file back "
                "as it was, or begin anew with another --out"
            )
        if start > 0:
            with path.open("rb") as file:
                file.seek(start - 1)
                if file.read(1) != b"\n":
                    raise UserError(f"cannot resume: {path} has no end of a row at byte {start}; it was changed")
        starts[name] = start
    return starts


def _read_rows(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a file that may be absent, but for a half-written last one.

    Raises:
        DamagedFileError: a row is not what `write` writes.
    """
    if not path.is_file():
        return
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                return
            row = parse_object(line, f"line {number} of {path}")
            if not isinstance(row.get("kind"), str) or type(row.get("env_steps")) is not int:
                raise DamagedFileError(f"line {number} of {path} has no kind and env_steps")
            yield row


def _append(file: BinaryIO, line: bytes) -> None:
    """Append the whole line or nothing."""
    start = os.fstat(file.fileno()).st_size
    try:
        if file.write(line) != len(line):
            raise OSError(0, "the disk is full")
    except OSError as error:
        with contextlib.suppress(OSError):
            os.ftruncate(file.fileno(), start)
        raise UserError(f"cannot write metrics: {error.strerror}; make room, then resume") from error


def _plain(value: Any) -> Any:
    """Turn a value, NumPy's too, into JSON; what JSON cannot say (NaN, infinities) into None."""
    if isinstance(value, str):
        return value
    plain = np.asarray(value).tolist()
    if isinstance(plain, list):
        return [_plain(item) for item in plain]
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain
