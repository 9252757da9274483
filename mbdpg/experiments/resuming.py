"""Going on with runs exactly where they stopped."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.origin import machine
from mbdpg.experiments.recorder import Recorder
from mbdpg.experiments.run import MakeEnvironment, OnUpdate, compose, spec_of
from mbdpg.interfaces import UserError, require
from mbdpg.storage.checkpoint import Checkpoint, load_checkpoint
from mbdpg.storage.run_folder import RunFolder


def resume(
    runs: Sequence[Path],
    *,
    make_env: MakeEnvironment | None = None,
    steps: int | None = None,
    allow_import: bool = False,
    watch: Callable[[Sequence[Path], RunConfig, int], OnUpdate] = lambda runs, config, env_steps: lambda update: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> None:
    """Go on with runs, each exactly where its newest undamaged checkpoint is.

    Runs that differ in nothing but their seed and stand at the same place go on at once. All are read, and locked,
    before the first goes on: if one cannot be resumed, none is.

    Args:
        runs: the run folders.
        make_env: as for `train`; needed if a run was given one.
        steps: environment steps of each whole run, if it shall be longer than it was meant to be.
        allow_import: allow an id of the form module:Id, whatever the folder says: it may come from a stranger.
        watch: given runs that go on at once, their config and the step they go on from, returns what `train` calls
            `on_update`.
        should_stop: as for `train`.

    Raises:
        UserError: not a run, damaged beyond its checkpoints, or of another configuration or environment.
    """
    with contextlib.ExitStack() as stack:
        together: dict[str, list[_Saved]] = defaultdict(list)
        for path in runs:
            try:
                saved = _saved(path, stack, make_env is not None, steps, allow_import)
            except UserError as error:
                way = "; so none was resumed: the others go on if each is given by itself" if len(runs) > 1 else ""
                raise UserError(f"{error}{way}") from error
            together[saved.place].append(saved)
        for group in together.values():
            if not should_stop():
                _go_on(group, make_env or group[0].config.make_env, watch, should_stop)


class _Saved(NamedTuple):
    """A run that is to go on."""

    folder: RunFolder
    config: RunConfig
    checkpoint: Checkpoint

    @property
    def place(self) -> str:
        """The same for runs that can go on at once."""
        names = ("updates", "recorded", "ended", "expert_env_steps")
        facts = {name: self.checkpoint.facts.get(name) for name in names}
        return json.dumps([self.config.to_json(), self.checkpoint.env_steps, facts], sort_keys=True)


def _saved(path: Path, stack: contextlib.ExitStack, has_env: bool, steps: int | None, allow_import: bool) -> _Saved:
    """Lock and read a run."""
    folder = RunFolder.open(path)
    config = RunConfig.of(folder)
    config = dataclasses.replace(config, env_options=dataclasses.replace(config.env_options, allow_import=allow_import))
    if folder.config.get("custom_env") and not has_env:
        raise UserError(f"{path} trained an environment made in code; resume it with mbdpg.resume(..., env=...)")
    stack.enter_context(folder.locked())
    checkpoint = load_checkpoint(path)
    with _as_written_by_us([path], checkpoint.env_steps):
        planned = int(checkpoint.facts["steps"])
    require(
        steps is None or steps >= checkpoint.env_steps,
        f"--steps is {steps}, but {path} has {checkpoint.env_steps} behind it; expected at least as many",
    )
    schedule = dataclasses.replace(config.schedule, steps=planned if steps is None else steps)
    return _Saved(folder, dataclasses.replace(config, schedule=schedule), checkpoint)


def _go_on(
    group: Sequence[_Saved],
    make: MakeEnvironment,
    watch: Callable[[Sequence[Path], RunConfig, int], OnUpdate],
    should_stop: Callable[[], bool],
) -> None:
    """Train on, all in this process."""
    paths, config, checkpoints = [s.folder.path for s in group], group[0].config, [s.checkpoint for s in group]
    spec = spec_of(make, config.env_options)
    with contextlib.ExitStack() as stack:
        recorders, seeds = [], []
        for s in group:
            with _as_written_by_us([s.folder.path], s.checkpoint.env_steps):
                recorders.append(Recorder(s.folder, s.checkpoint))
                seeds.append(_seed_of(s.folder))
        with _as_written_by_us(paths, checkpoints[0].env_steps):
            training = compose(config, spec, make, seeds, recorders, stack, None, checkpoints)
        for s in group:
            _say_what_changed(s.folder.path, s.folder.config.get("machine"), machine(len(group)))
        training.run(watch(paths, config, training.env_steps), should_stop)


@contextlib.contextmanager
def _as_written_by_us(runs: Sequence[Path], env_steps: int) -> Iterator[None]:
    """Whatever a stranger's checkpoint makes fail is said in one line."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        names = ", ".join(map(str, runs))
        raise UserError(
            f"the checkpoint of {names} at {env_steps} steps is not one that mbdpg wrote ({error!r})"
        ) from error


def _say_what_changed(path: Path, recorded: Any, now: dict[str, Any]) -> None:
    """A resume repeats bytes only on the same processor, cores and versions: say what is another one now."""
    before: dict[str, Any] = recorded if isinstance(recorded, dict) else {}
    versions = before.get("versions")
    versions = versions if isinstance(versions, dict) else {}
    changed = [name for name in ("cpu", "cores", "devices", "python", "XLA_FLAGS") if before.get(name) != now[name]]
    changed += [name for name, version in now["versions"].items() if versions.get(name) != version]
    if changed:
        print(
            f"mbdpg: {path} was begun elsewhere, with other {', '.join(changed)}; its results may differ",
            file=sys.stderr,
        )


def _seed_of(folder: RunFolder) -> int:
    seed = folder.config.get("seed")
    fits = isinstance(seed, int) and 0 <= seed < 2**31
    require(fits, f"{folder.path} has seed {seed!r} in its config.json, expected a number from 0 to 2^31 - 1")
    return int(seed)  # type: ignore[arg-type]  # checked above
