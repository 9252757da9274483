"""What `mbdpg sweep` is asked to search: the values that settings may take."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal, final, get_args, get_origin, get_type_hints

from mbdpg.interfaces import UserError, flag_of, require


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
        require(name in known, f"--search {text}: there is no {flag_of(name)}; expected a setting of the algorithm")
        low, colon, rest = values.partition(":")
        if not colon:
            choices = tuple(part for part in values.split(",") if part)
            different = bool(equals) and 1 < len(choices) == len(set(choices))
            require(different, f"--search {text}: expected {name}=LOW:HIGH or {name}=A,B,C")
            for choice in choices:
                _typed(choice, get_type_hints(type(agent))[name], text)
            return cls(name, choices=choices)
        kind = get_type_hints(type(agent))[name]
        if kind not in (int, float):
            names = ", ".join(map(str, get_args(kind))) or "true, false"
            raise UserError(f"--search {text}: expected some of {names}, with commas between")
        high, _, scale = rest.partition(":")
        require(scale in ("", "log"), f"--search {text}: expected :log or nothing after the range")
        try:
            found = cls(name, float(low), float(high), scale == "log")
        except ValueError as error:
            raise UserError(f"--search {text}: expected numbers, {name}=LOW:HIGH") from error
        whole = kind is float or round(found.low) < round(found.high)
        require(whole, f"--search {text}: expected two whole numbers, a lower one before a higher one")
        ordered = math.isfinite(found.low) and math.isfinite(found.high) and found.low < found.high
        require(ordered, f"--search {text}: expected a lower number before a higher one")
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
    if get_origin(kind) is Literal:
        known = {str(value): value for value in get_args(kind)}
        expected = f"some of {', '.join(known)}, with commas between"
    elif kind is bool:
        known, expected = {"true": True, "false": False}, "true,false"
    else:
        try:
            return kind(choice)
        except ValueError as error:
            numbers = "whole numbers" if kind is int else "numbers"
            raise UserError(f"--search {text}: expected {numbers}, not {choice}") from error
    require(choice in known, f"--search {text}: expected {expected}")
    return known[choice]
