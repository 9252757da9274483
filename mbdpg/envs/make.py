"""From a Gymnasium id, or an environment made in code, to an `Environment`: name it, make it, validate it."""

from __future__ import annotations

import difflib
import functools
import importlib
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import DependencyNotInstalled
from gymnasium.spaces import Box

from mbdpg.envs.rendering import prepare_headless_rendering, rendering_options, widen_floor
from mbdpg.envs.wrappers import GymnasiumEnvironment, cannot_draw, missing_package, with_fresh_world
from mbdpg.interfaces import EnvSpec, UserError

# By id without its version; goes before Gymnasium's own reward threshold.
REFERENCE_RETURNS = {
    "HalfCheetah": 8000.0,
    "Hopper": 3000.0,
    "Ant": 4000.0,
    "BipedalWalker": 280.0,
    "LunarLanderContinuous": 200.0,
    "Pendulum": -200.0,
}

_MUJOCO_NAMES = (
    *("Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum", "InvertedPendulum"),
    *("Pusher", "Reacher", "Swimmer", "Walker2d"),
)
# Ids of the paper's time. Gymnasium still lists MuJoCo's v2 and v3, but making them fails.
OLD_IDS = {f"{name}-v{version}": f"{name}-v5" for name in _MUJOCO_NAMES for version in (2, 3)} | {
    "LunarLanderContinuous-v2": "LunarLanderContinuous-v3",
    "BipedalWalker-v2": "BipedalWalker-v3",
}

ANT_CONTACT_FORCES = {27: False, 105: True}  # observation size of Ant-v5, to whether it includes 78 contact forces

MakeGymnasium = Callable[[], gymnasium.Env[Any, Any]]
"""Makes an environment of a user's own."""

ROLES = ("train", "evaluate", "expert", "test")

# Known, harmless, and not the user's to mend. As an error, Box2D's would crash the interpreter on import.
_GYMNASIUM_NOISE = (
    r"builtin type (SwigPyPacked|SwigPyObject|swigvarlink) has no __module__ attribute",
    r".*The environment \S+ is out of date",
)
_MUJOCO_NOISE = "compiler attribute 'settotalmass' is deprecated"


def make(
    env_id: str,
    *,
    max_episode_steps: int | None = None,
    observation_size: int | None = None,
    render: bool = False,
    allow_import: bool = False,
) -> GymnasiumEnvironment:
    """Makes a registered Gymnasium environment ready for the agents.

    Args:
        env_id: Gymnasium id, such as `Hopper-v5`; an id of 2022 is replaced, with a notice on stderr.
        max_episode_steps: steps after which an episode is truncated; None keeps the registered limit.
        observation_size: for Ant-v5 alone, 27 or 105 (without or with contact forces); None keeps the registered one.
        render: whether `render()` can be called.
        allow_import: whether an id `module:Id` may import, and so run, the code of that module.

    Raises:
        UserError: the id is unknown, the environment does not fit, or a package it needs is missing.
    """
    if max_episode_steps is not None and max_episode_steps < 1:
        raise UserError(f"--max-episode-steps is {max_episode_steps}, expected at least 1; or leave it out")
    known_id = _known_id(env_id, allow_import)
    options = _ant_options(known_id, observation_size)
    if render:
        prepare_headless_rendering()
        options |= rendering_options(known_id)
    env = _create(known_id, max_episode_steps, options)
    if render:
        widen_floor(env, known_id)
    try:
        return wrap(env)
    except UserError:
        env.close()
        raise


def wrap(env: gymnasium.Env[Any, Any], *, name: str | None = None) -> GymnasiumEnvironment:
    """Makes an environment that was made in code, registered or not, ready for the agents.

    Args:
        env: any gymnasium.Env with a 1-D Box of observations and a bounded 1-D Box of actions.
        name: what to call it; None takes its Gymnasium id, or else the name of its class.

    Raises:
        UserError: the environment does not fit; the text says what would.
    """
    layers = _layers(env)
    registered = env.spec
    env_id = name or (type(env.unwrapped).__name__ if registered is None else registered.id)
    if any(isinstance(layer, gymnasium.wrappers.Autoreset) for layer in layers):
        raise UserError(f"{env_id} is inside gymnasium.wrappers.Autoreset, which hides where episodes end; take it off")
    limits = [layer._max_episode_steps for layer in layers if isinstance(layer, gymnasium.wrappers.TimeLimit)]
    if registered is not None and registered.max_episode_steps is not None:
        limits.append(registered.max_episode_steps)
    spec = EnvSpec(
        id=env_id,
        observation_size=_observation_size(env, env_id),
        action_size=_action_size(env, env_id),
        episode_limit=min(limits, default=None),
        reference_return=_reference_return(registered),
    )
    return GymnasiumEnvironment(with_fresh_world(env), spec)


def episode_seed(run_seed: int, role: str, episode: int) -> int:
    """Returns the 31-bit environment seed of one episode.

    The two highest bits are the role's number, so that no two roles ever share a seed, whatever the runs; the other 29
    come from NumPy's SeedSequence.

    Args:
        run_seed: seed of the run, at least 0.
        role: "train", "evaluate" (in training), "expert" or "test" (afterwards).
        episode: index of the episode within run and role, at least 0.

    Raises:
        ValueError: unknown role, or a negative number.
    """
    if role not in ROLES:
        raise ValueError(f"role is {role!r}, expected one of {', '.join(ROLES)}")
    number = ROLES.index(role)
    word = int(np.random.SeedSequence(run_seed, spawn_key=(number, episode)).generate_state(1)[0])
    return number << 29 | word >> 3


def current_id(env_id: str) -> str:
    """The id that stands in the place of one that is no longer in Gymnasium, which is said; any other as it is."""
    if env_id in OLD_IDS:
        _say_once(f"{env_id} is no longer in Gymnasium; using {OLD_IDS[env_id]}")
    return OLD_IDS.get(env_id, env_id)


def _known_id(env_id: str, allow_import: bool) -> str:
    """Returns the registered id that `env_id` means; imports its module first if it names one and that is allowed."""
    module, separator, name = env_id.rpartition(":")
    if separator:
        if not allow_import:
            raise UserError(
                f"{env_id} would run the code of the module {module}; if you trust it, pass --allow-import, or in "
                "Python a function that makes the environment"
            )
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise UserError(f"{env_id}: cannot import {module} ({error}); install it or set PYTHONPATH") from error
    name = current_id(name)
    if name not in gymnasium.registry:
        ids = {known.lower(): known for known in gymnasium.registry if known not in OLD_IDS}
        nearest = difflib.get_close_matches(name.lower(), ids, n=3, cutoff=0.0)
        raise UserError(f"{name or 'an empty id'} is not registered; nearest are {', '.join(ids[n] for n in nearest)}")
    return name


@functools.cache
def _say_once(notice: str) -> None:
    print(notice, file=sys.stderr)


def _ant_options(env_id: str, observation_size: int | None) -> dict[str, Any]:
    """Returns the constructor arguments that give `observation_size`; none for None."""
    if observation_size is None:
        return {}
    if env_id != "Ant-v5":
        raise UserError(f"--observation-size is {observation_size}, but only Ant-v5 lets you choose; leave it out")
    if observation_size not in ANT_CONTACT_FORCES:
        raise UserError(f"Ant-v5 cannot have {observation_size} observations; expected 27 or 105 (the default)")
    return {"include_cfrc_ext_in_observation": ANT_CONTACT_FORCES[observation_size]}


def _create(env_id: str, max_episode_steps: int | None, options: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    """Calls gymnasium.make; its passive checker is off, because it looks at the first step only and we at each."""
    entry_point = gymnasium.registry[env_id].entry_point
    try:
        with _quiet_construction(entry_point):
            return gymnasium.make(env_id, max_episode_steps, disable_env_checker=True, **options)
    except (DependencyNotInstalled, ImportError) as error:
        raise missing_package(env_id, str(entry_point), error) from error
    except TypeError as error:
        if "render_mode" in options and "unexpected keyword argument 'render_mode'" in str(error):
            raise UserError(f"{env_id} has no render_mode, so it cannot draw frames; make it without render") from error
        raise
    except (AttributeError, RuntimeError) as error:
        if "mujoco" in str(entry_point) and os.environ.get("MUJOCO_GL") and "mujoco" not in sys.modules:
            raise cannot_draw(env_id, error) from error  # mujoco loads its back end on import
        raise


@contextmanager
def _quiet_construction(entry_point: object) -> Iterator[None]:
    """Holds back the known noise of importing and constructing an environment, and nothing else.

    MuJoCo warns from C, on stderr and in a file MUJOCO_LOG.TXT in the current folder; here its unknown warnings go to
    whoever handled them before, or else to stderr.
    """
    with warnings.catch_warnings():
        for message in _GYMNASIUM_NOISE:
            warnings.filterwarnings("ignore", message=message, category=DeprecationWarning)
        if isinstance(entry_point, str):
            importlib.import_module(entry_point.partition(":")[0])
        mujoco: Any = sys.modules.get("mujoco")  # an environment that needs it has imported it by now
        if mujoco is None:
            yield
            return
        previous = mujoco.get_mju_user_warning()

        def pass_on(message: str) -> None:
            if _MUJOCO_NOISE in message:
                return
            if previous is not None:
                previous(message)
            else:
                print(f"MuJoCo: {message}", file=sys.stderr)

        mujoco.set_mju_user_warning(pass_on)
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(previous)


def _layers(env: object) -> list[gymnasium.Env[Any, Any]]:
    """Lists `env` and what it wraps, outermost first; refuses vectors of environments and those of the old Gym."""
    if not isinstance(env, gymnasium.Env):
        raise UserError(f"found {type(env).__name__}, expected a single gymnasium.Env: convert it or choose another")
    layers = [env]
    while isinstance(layers[-1], gymnasium.Wrapper):
        layers.append(layers[-1].env)
    return layers


def _observation_size(env: gymnasium.Env[Any, Any], env_id: str) -> int:
    space = getattr(env, "observation_space", None)  # unset where the author forgot it
    if not isinstance(space, Box) or len(space.shape) != 1 or space.shape[0] < 1:
        raise UserError(
            f"{env_id} has the observation space {_shown(space)}, expected a 1-D Box; apply "
            "gymnasium.wrappers.FlattenObservation in code, then mbdpg.envs.wrap"
        )
    return space.shape[0]


def _action_size(env: gymnasium.Env[Any, Any], env_id: str) -> int:
    space = getattr(env, "action_space", None)
    found = f"{env_id} has the action space {_shown(space)}, expected a bounded 1-D Box of floats"
    if not isinstance(space, Box):
        raise UserError(f"{found}; choose an environment with continuous actions")
    if len(space.shape) != 1 or space.shape[0] < 1 or not np.issubdtype(space.dtype, np.floating):
        raise UserError(f"{found}; apply gymnasium.wrappers.TransformAction in code, then mbdpg.envs.wrap")
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise UserError(
            f"{found}; give it finite bounds with gymnasium.wrappers.TransformAction(env, lambda action: action, "
            "Box(low, high)) in code, then mbdpg.envs.wrap"
        )
    return space.shape[0]


def _shown(space: object) -> str:
    """The space in one line of at most 100 characters."""
    text = " ".join(str(space).split())
    return text if len(text) <= 100 else f"{text[:97]}..."


def _reference_return(registered: Any) -> float | None:
    if registered is None:
        return None
    known = REFERENCE_RETURNS.get(re.sub(r"-v\d+$", "", registered.id), registered.reward_threshold)
    return None if known is None else float(known)
