"""What stands around a Gymnasium environment: the boundary to the rest of the system, and a mend for BipedalWalker."""

from __future__ import annotations

import os
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.error import DependencyNotInstalled

from mbdpg.interfaces import EnvSpec, NonFiniteError, Step, UserError, one_line

EXTRAS = {"box2d": "box2d", "mujoco": "mujoco", "classic_control": "classic-control"}
"""Folder of gymnasium.envs, to the extra of the pip package that its environments need."""

LARGEST = float(np.finfo(np.float32).max)
"""A reward beyond it would be an infinity to the agents."""


@final
class GymnasiumEnvironment:
    """A Gymnasium environment behind the `Environment` protocol; the only place that knows the real action bounds.

    Made by `mbdpg.envs.make` and `mbdpg.envs.wrap`, which check the spaces first. What the environment itself raises
    in `reset` and `step` comes through unchanged.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], spec: EnvSpec) -> None:
        box: Any = env.action_space
        self.spec = spec
        self._env = env
        self._observation_shape = (spec.observation_size,)
        self._action_shape = (spec.action_size,)
        self._action_dtype = box.dtype
        self._low = box.low.astype(np.float64)
        self._high = box.high.astype(np.float64)
        self._middle = self._low / 2 + self._high / 2
        self._half_range = self._high / 2 - self._low / 2
        self._one = np.ones(spec.action_size)
        self._minus_one = -self._one

    def reset(self, *, seed: int) -> np.ndarray:
        """Starts the episode that `seed` decides; returns its first observation, float32 (observation_size,).

        Raises:
            NonFiniteError: the observation has a NaN or an infinity.
        """
        observation, _ = self._env.reset(seed=seed)
        return self._checked(observation)

    def step(self, action: np.ndarray) -> Step:
        """Takes one step; when the episode is over it does not reset by itself.

        Args:
            action: shape (action_size,), in [-1, 1]; what lies beyond is clipped.

        Raises:
            NonFiniteError: the observation or the reward has a NaN or, as float32, an infinity.
            UserError: the action has another shape, a NaN or an infinity, and the environment was not stepped; or the
                observation has not the shape that the environment promised.
        """
        observation, reward, terminated, truncated, _ = self._env.step(self._real_action(action))
        observation = self._checked(observation)
        reward = float(reward)
        if not abs(reward) <= LARGEST:
            raise NonFiniteError(f"{self.spec.id} returned the reward {reward}")
        return Step(observation, reward, bool(terminated), bool(truncated))

    def render(self) -> np.ndarray:
        """Returns the current frame, uint8 (height, width, 3).

        Raises:
            UserError: the environment was made without frames, or this machine cannot draw them.
        """
        if self._env.render_mode != "rgb_array":
            raise UserError(
                f"{self.spec.id} was made with render_mode={self._env.render_mode!r}, expected 'rgb_array': "
                "make it with render=True, or in code with render_mode='rgb_array'"
            )
        frame = _draw(self._env, self.spec.id)
        if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            found = f"{frame.dtype} {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
            raise UserError(f"{self.spec.id} rendered {found}, expected uint8 (height, width, 3): mend its render()")
        return np.ascontiguousarray(frame)

    @property
    def frames_per_second(self) -> float:
        """Rendered steps per second of real time, as the environment says; 30 if it does not."""
        return float(self._env.metadata.get("render_fps") or 30.0)

    def close(self) -> None:
        """Frees what the environment holds."""
        self._env.close()

    def _real_action(self, action: np.ndarray) -> np.ndarray:
        """Maps [-1, 1] to the real bounds in float64, then casts to the dtype of the action space."""
        scaled = np.array(action, dtype=np.float64)
        if scaled.shape != self._action_shape:
            shapes = f"the shape {scaled.shape}, expected {self._action_shape}"
            raise UserError(f"{self.spec.id} was not stepped: the policy's action has {shapes}")
        if np.count_nonzero(np.isfinite(scaled)) != scaled.size:  # half the time of isfinite().all()
            found = f"the policy's action has {_first_non_finite(scaled)}, expected finite numbers"
            raise UserError(f"{self.spec.id} was not stepped: {found}")
        np.minimum(scaled, self._one, out=scaled)
        np.maximum(scaled, self._minus_one, out=scaled)
        scaled *= self._half_range
        scaled += self._middle
        # Rounding can leave the bounds by one unit in the last place, which strict environments refuse.
        np.minimum(scaled, self._high, out=scaled)
        np.maximum(scaled, self._low, out=scaled)
        return scaled.astype(self._action_dtype)

    def _checked(self, observation: Any) -> np.ndarray:
        """Copies to float32 (an environment may reuse its array); refuses NaN, infinities and other shapes."""
        cast = np.array(observation, dtype=np.float32, order="C")
        if cast.shape != self._observation_shape:
            raise UserError(
                f"{self.spec.id} returned an observation of shape {cast.shape}, but its observation_space says "
                f"{self._observation_shape}: mend one of them"
            )
        if np.count_nonzero(np.isfinite(cast)) != cast.size:
            raise NonFiniteError(f"{self.spec.id} returned observation {_first_non_finite(cast)}")
        return cast


@final
class FreshWorld(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Gives BipedalWalker a new Box2D world at every reset, so that its seed alone decides the episode.

    Upstream keeps the old world, and what it remembers leaks into the next episode: with the same seed a used and a
    fresh environment part after a few steps. LunarLander already has this fix (Gymnasium #728).
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets in a new world; arguments and result as in Gymnasium."""
        import Box2D  # optional; present wherever there is a BipedalWalker

        walker: Any = self.unwrapped
        walker._destroy()
        walker.world = Box2D.b2World()
        return self.env.reset(seed=seed, options=options)


def with_fresh_world(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """Returns `env`, inside `FreshWorld` if it is a BipedalWalker of any kind (Hardcore and subclasses too)."""
    return FreshWorld(env) if _is_from(env, "gymnasium.envs.box2d.bipedal_walker") else env


def missing_package(env_id: str, module: str, error: Exception) -> UserError:
    """Says which pip command mends `error`, raised because `module`, where the environment lives, lacks a package."""
    family = module.removeprefix("gymnasium.envs.").partition(".")[0]
    if family in EXTRAS:
        return UserError(f'{env_id} needs a package that is not installed: pip install "gymnasium[{EXTRAS[family]}]"')
    return UserError(f"{env_id} needs a package that is not installed ({_named(error)}): pip install that package")


def cannot_draw(env_id: str, error: Exception) -> UserError:
    """Says how to give MuJoCo a working OpenGL back end, after `error`."""
    return UserError(
        f"{env_id} cannot draw on this machine with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')} ({_named(error)}): "
        "set MUJOCO_GL=egl (Debian: apt install libegl1 libegl-mesa0 libgl1) or MUJOCO_GL=osmesa (Debian: apt install "
        "libosmesa6), or unset it and do without frames"
    )


def _draw(env: gymnasium.Env[Any, Any], env_id: str) -> Any:
    """Renders; turns the failures that a missing package or a missing screen cause into a UserError."""
    try:
        return env.render()
    except DependencyNotInstalled as error:
        raise missing_package(env_id, type(env.unwrapped).__module__, error) from error
    except gymnasium.error.Error:  # wrong use, such as no reset yet: says so itself
        raise
    except Exception as error:  # MuJoCo's back ends fail with anything from AttributeError to GLError
        if not _is_from(env, "gymnasium.envs.mujoco"):
            raise
        raise cannot_draw(env_id, error) from error


def _is_from(env: gymnasium.Env[Any, Any], module: str) -> bool:
    """Says whether the innermost class of `env`, or one it derives from, is defined in `module` or below it."""
    # By name: importing the class would import its optional dependency.
    return any(f"{kind.__module__}.".startswith(f"{module}.") for kind in type(env.unwrapped).__mro__)


def _first_non_finite(values: np.ndarray) -> str:
    """Names the first entry that is not finite, such as `entry 3 = nan`."""
    index = int(np.flatnonzero(~np.isfinite(values))[0])
    return f"entry {index} = {values[index]}"


def _named(error: Exception) -> str:
    return one_line(f"{type(error).__name__}: {error}")
