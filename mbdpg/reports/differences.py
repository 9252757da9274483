"""In which settings, versions and machines runs differ."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from mbdpg.reports.record import Record, setting, text

ABSENT = ""
"""In the place of a setting that an algorithm does not have."""


class Difference(NamedTuple):
    """A setting that is not the same in all runs."""

    name: str
    cells: list[str]
    """What each group has; where its runs differ, which of them have what."""
    own: bool
    """All groups that have this setting at all agree: only some algorithms know it."""


def differences(groups: Mapping[str, Sequence[Record]]) -> list[Difference]:
    """Whatever differs between these runs, by the label of their group, but for the seed."""
    columns = [[(run.name, _flat(run.config)) for run in runs] for runs in groups.values()]
    found = []
    for name in dict.fromkeys(name for column in columns for _, values in column for name in values):
        cells = [[(run, values.get(name, ABSENT)) for run, values in column] for column in columns]
        values = {value for cell in cells for _, value in cell}
        if len(values) > 1:
            found.append(Difference(name, list(map(_cell, cells)), own=len(values - {ABSENT}) == 1))
    return found


def commit(config: Mapping[str, Any]) -> str:
    """The commit of a run in ten digits, with a + if its checkout had changes; a dash where there is none."""
    whole = text(config.get("commit"))
    return whole[:10] + "+" * (whole.endswith("+") and len(whole) > 10)


def machine(config: Mapping[str, Any]) -> str:
    """The machine of a run in a few words."""
    parts = setting(config, "machine")
    if not parts:
        return "a machine that is not noted"
    cores, system = parts.get("cores"), text(parts.get("platform")).partition("-")[0]
    accelerated = "cpu" not in (devices := text(parts.get("devices", "cpu")))
    words = [devices] * accelerated + [text(parts.get("cpu")), f"{text(cores)} core{'s' * (cores != 1)}", system]
    return ", ".join(words)


def _flat(config: Mapping[str, Any]) -> dict[str, str]:
    """Settings by name, as text; those of the run and of the agent come first."""
    machine = setting(config, "machine")
    groups = {
        "": {name: config.get(name) for name in ("algorithm", "demonstrations")} | {"commit": commit(config)},
        "agent ": setting(config, "agent"),
        "schedule ": setting(config, "schedule"),
        "env ": setting(config, "env_options"),
        "machine ": {name: value for name, value in machine.items() if name != "versions"},
        "version ": setting(machine, "versions"),
    }
    return {f"{group}{name}": text(value) for group, values in groups.items() for name, value in values.items()}


def _cell(values: Sequence[tuple[str, str]]) -> str:
    """What the runs of a group have, given as (run, value)."""
    runs = defaultdict(list)
    for run, value in values:
        runs[value].append(run)
    if len(runs) == 1:
        return next(iter(runs))
    return "; ".join(f"{value or 'absent'} ({', '.join(own)})" for value, own in runs.items())
