"""What `mbdpg sweep` is asked to search: the values that settings may take."""

from __future__ import annotations

import dataclasses
import difflib
import math
from dataclasses import dataclass
from typing import Any, final, get_args, get_type_hints

from mbdpg.interfaces import UserError, require


@final
@dataclass(frozen=True)
class Search:
    """The values that one setting may take: a range of numbers, or some choices."""

    name: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    choices: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str, agent: Any) -> Search:
        """Read `horizon=1:20`, `actor-learning-rate=1e-5:1e-3:log` or `gradient=full,eq19`.

        Raises:
            UserError: it is none of these, or the agent has no such setting.
        """
        name, equals, values = text.partition("=")
        name = name.removeprefix("--").replace("-", "_")
        known = {field.name for field in dataclasses.fields(agent)}
        near = difflib.get_close_matches(name, known, 1) or sorted(known)[:1]
        require(name in known, f"--search {text}: {name!r} is no setting of the algorithm; one is {near[0]}")
        low, colon, rest = values.partition(":")
        if not colon:
            choices = tuple(part for part in values.split(",") if part)
            wanted = f"expected at least two, {_choices(get_type_hints(type(agent))[name], name)}"
            require(bool(equals) and len(choices) > 1, f"--search {text}: {wanted}")
            values_ = {_typed(choice, get_type_hints(type(agent))[name], text) for choice in choices}
            require(len(values_) == len(choices), f"--search {text}: {wanted}, all different")
            return cls(name, choices=choices)
        kind = get_type_hints(type(agent))[name]
        if kind not in (int, float):
            raise UserError(f"--search {text}: expected {_choices(kind, name)}")
        high, _, scale = rest.partition(":")
        require(scale in ("", "log"), f"--search {text}: expected :log or nothing after the range")
        try:
            found = cls(name, float(low), float(high), scale == "log")
        except ValueError as error:
            raise UserError(f"--search {text}: expected numbers, {name}=LOW:HIGH") from error
        ordered = math.isfinite(found.low) and math.isfinite(found.high) and found.low < found.high
        require(ordered, f"--search {text}: expected a lower number before a higher one")
        whole = kind is float or (found.low.is_integer() and found.high.is_integer())
        require(whole, f"--search {text}: expected two whole numbers, a lower one before a higher one")
        require(not found.log or found.low > 0, f"--search {text}: a logarithmic range begins above 0")
        return found

    def suggest(self, trial: Any, agent: Any) -> Any:
        """This trial's value, of the setting's own type."""
        kind = get_type_hints(type(agent))[self.name]
        if self.choices:
            return _typed(trial.suggest_categorical(self.name, list(self.choices)), kind, self.name)
        if kind is int:
            return trial.suggest_int(self.name, round(self.low), round(self.high), log=self.log)
        return trial.suggest_float(self.name, self.low, self.high, log=self.log)


def _typed(choice: str, kind: Any, text: str) -> Any:
    """A choice as the setting's type has it."""
    if kind in (int, float):
        try:
            number = kind(choice)
        except ValueError as error:
            numbers = "whole numbers" if kind is int else "numbers"
            raise UserError(f"--search {text}: expected {numbers}, not {choice}") from error
        require(math.isfinite(number), f"--search {text}: expected finite numbers, not {choice}")
        return number
    known = _named(kind)
    require(choice in known, f"--search {text}: expected {_choices(kind, '')}")
    return known[choice]


def _named(kind: Any) -> dict[str, Any]:
    """The values of a setting that is no number, by name."""
    return {"true": True, "false": False} if kind is bool else {str(value): value for value in get_args(kind)}


def _choices(kind: Any, name: str) -> str:
    """What may be searched of a setting."""
    if kind in (int, float):
        return f"{name}=LOW:HIGH or {name}=A,B,C"
    return f"some of {', '.join(_named(kind))}, with commas between"
