"""The rules by which some simulators end an episode: an oracle, to separate the model's errors from the method's."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mbdpg.interfaces import EnvSpec, UserError

Rule = Callable[[Float[Array, "*batch observation"]], Bool[Array, "*batch"]]
"""Whether the episode goes on, from a raw next observation."""


def _hopper(o: Array) -> Array:
    return (o[..., 0] > 0.7) & (jnp.abs(o[..., 1]) < 0.2) & jnp.all(jnp.abs(o[..., 1:]) < 100.0, axis=-1)


def _walker(o: Array) -> Array:
    return (o[..., 0] > 0.8) & (o[..., 0] < 2.0) & (jnp.abs(o[..., 1]) < 1.0)


def _ant(o: Array) -> Array:
    return (o[..., 0] >= 0.2) & (o[..., 0] <= 1.0) & jnp.all(jnp.isfinite(o), axis=-1)


def _never(o: Array) -> Array:
    return jnp.ones(o.shape[:-1], bool)


RULES: dict[str, Rule] = {
    "Hopper": _hopper,
    "Walker2d": _walker,
    "Ant": _ant,
    "HalfCheetah": _never,
    "Swimmer": _never,
    "Reacher": _never,
    "Pendulum": _never,
}
"""By the id without its version, as Gymnasium's MuJoCo tasks have them from v4 on."""


def known_rule(env: EnvSpec) -> str:
    """The name of an environment's rule.

    Raises:
        UserError: it is not known.
    """
    name, _, version = env.id.rpartition("-v")
    if name not in RULES or not version.isdigit() or (int(version) < 4 and name != "Pendulum"):
        raise UserError(
            f"--termination is known, but the rule of {env.id} is not; expected learned, or a task out of "
            + ", ".join(RULES)
        )
    return name
