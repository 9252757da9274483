"""What the tests of several agents share."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest


@pytest.fixture
def differences() -> Callable[[Any, Any], set[str]]:
    """Compares two states: names the fields in which they differ in any bit."""

    def same(a: jax.Array, b: jax.Array) -> bool:
        return np.asarray(a).tobytes() == np.asarray(b).tobytes()

    def compare(before: Any, after: Any) -> set[str]:
        fields = {name: (getattr(before, name), getattr(after, name)) for name in vars(before)}
        return {name for name, pair in fields.items() if not all(jax.tree.leaves(jax.tree.map(same, *pair)))}

    return compare
