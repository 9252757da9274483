"""Names of a pytree's leaves, as files have them."""

from __future__ import annotations

from typing import Any


def leaf_name(path: Any) -> str:
    """The name of the leaf at a path that `jax.tree_util` gives, as in `actor/mlp/hidden/0/weight`."""
    return "/".join(str(getattr(key, "name", getattr(key, "idx", getattr(key, "key", key)))) for key in path)
