"""What an environment raises, told apart from what anything else does."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from mbdpg.interfaces import UserError, one_line

Result = TypeVar("Result")


class EnvironmentFailedError(Exception):
    """Whatever an environment raised, a NaN included; the text is one line."""


def guarded(call: Callable[[], Result]) -> Result:
    """Call into an environment.

    Raises:
        EnvironmentFailedError: it raised something.
        UserError: it does not keep what its spaces promise; that is for a person to mend.
    """
    try:
        return call()
    except UserError:
        raise
    except Exception as error:
        raise EnvironmentFailedError(one_line(f"{type(error).__name__}: {error}")) from error
