"""How robots are filmed: with no display, with a camera that follows them, over a floor that does not end."""

from __future__ import annotations

import ctypes.util
import os
import sys
from typing import Any

import gymnasium

# The default camera stays where the robot began, and soon films an empty floor.
TRACKED = {f"{name}-v5" for name in ("Ant", "HalfCheetah", "Hopper", "Humanoid", "Swimmer", "Walker2d")}
FARTHER = 100.0
"""So much wider than theirs is the floor that is drawn under them."""


def rendering_options(env_id: str) -> dict[str, Any]:
    """Returns the constructor's arguments that make `render` return frames."""
    return {"render_mode": "rgb_array"} | ({"camera_name": "track"} if env_id in TRACKED else {})


def widen_floor(env: gymnasium.Env[Any, Any], env_id: str) -> None:
    """Draws the floor as wide as robots run; to physics it has no end anyway."""
    if env_id in TRACKED:
        model = env.get_wrapper_attr("model")
        model.geom("floor").size[:2] *= FARTHER
        model.mat_texrepeat *= FARTHER


def prepare_headless_rendering() -> None:
    """On Linux without a display, lets MuJoCo and SDL draw without one, unless the user chose how already.

    They read the choice from the environment variables MUJOCO_GL and SDL_VIDEODRIVER, so this changes `os.environ`.
    """
    if not sys.platform.startswith("linux") or os.environ.get("DISPLAY"):
        return
    if not os.environ.get("SDL_VIDEODRIVER"):
        os.environ["SDL_VIDEODRIVER"] = "dummy"
    if not os.environ.get("MUJOCO_GL"):
        # Only a library that is there: with a bad MUJOCO_GL not even training works, for mujoco cannot be imported.
        for back_end, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
            if ctypes.util.find_library(library):
                os.environ["MUJOCO_GL"] = back_end
                return
