"""Curves that a run's evaluations hold: the return, and how well the model and the critics know the world."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import NamedTuple

from mbdpg.reports.record import Record

Values = list[float | None]
"""A number per evaluation; None where it is missing."""


class Line(NamedTuple):
    """One quantity, drawn for each group."""

    series: str
    """Its name in `series_of`."""
    label: str
    """What tells it from the chart's other line."""


class Chart(NamedTuple):
    """One or two quantities over the same axes; the second is dashed."""

    title: str
    note: str
    lines: list[Line]
    reference: float | None = None
    """What a perfect model or critic has, or the worth of a trivial one."""
    logarithmic: bool = False
    """Ratios, all above 0."""


RETURN = Chart("Mean evaluation return", "", [Line("return", "")])
_CRITIC = Chart(
    "Critic's value and realized return",
    "mean over evaluated states, discounted",
    [Line("value", "value"), Line("realized", "realized")],
)
_RETURN_AHEAD = Chart(
    "Return of 20 steps",
    "mean over evaluated states, discounted",
    [Line("return_imagined", "imagined"), Line("return_observed", "observed")],
)
_SURVIVAL = Chart(
    "Survival over 20 steps",
    "probability",
    [Line("survival_imagined", "imagined"), Line("survival_observed", "observed")],
)
_REWARD = Chart("Reward bias", "imagined minus paid, per step", [Line("reward_bias", "")], 0.0)
_RANGE = Chart("Imagined out of range", "share of entries beyond 5 std", [Line("out_of_range", "")])


def series_of(run: Record) -> dict[str, Values]:
    """The quantities that the run's evaluations have, by name."""
    realized = run.column("critic/realized_return")
    found = {
        "return": run.column("eval/return_mean"),
        "value": _combined(run.column("critic/q_bias"), realized, lambda bias, paid: bias + paid),
        "realized": realized,
        "return_imagined": run.column("dynamics/return_imagined"),
        "return_observed": run.column("dynamics/return_observed"),
        "survival_imagined": run.column("dynamics/survival_imagined"),
        "survival_observed": run.column("dynamics/survival_observed"),
        "reward_bias": run.column("dynamics/reward_bias"),
        "out_of_range": run.column("dynamics/out_of_range"),
    }
    for name in run.evaluations:
        if match := re.fullmatch(r"dynamics/rmse_k(\d{1,4})", name):
            persistence = run.column(f"dynamics/persistence_k{match[1]}")
            ratio = _combined(
                run.column(name), persistence, lambda error, still: error / still if min(error, still) > 0 else None
            )
            found[f"error_{int(match[1])}"] = ratio
    return {name: values for name, values in found.items() if any(value is not None for value in values)}


def diagnostics(names: Iterable[str]) -> list[Chart]:
    """The charts, beside that of the return, for which there are series of these names."""
    known = set(names)
    depths = sorted(int(name.removeprefix("error_")) for name in known if name.startswith("error_"))
    errors = [_error(depth) for depth in depths]
    rest = (_CRITIC, _RETURN_AHEAD, _SURVIVAL, _REWARD, _RANGE)
    return errors + [chart for chart in rest if known & {line.series for line in chart.lines}]


def _error(depth: int) -> Chart:
    title = f"Model error {depth} step{'s' * (depth > 1)} ahead"
    return Chart(title, "relative to predicting no change", [Line(f"error_{depth}", "")], 1.0, logarithmic=True)


def _combined(ours: Values, theirs: Values, of: Callable[[float, float], float | None]) -> Values:
    return [None if a is None or b is None else of(a, b) for a, b in zip(ours, theirs, strict=True)]
