"""The boundary class: actions out, observations in; and BipedalWalker's mended reset."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

import mbdpg.envs
from mbdpg.envs.wrappers import FreshWorld
from mbdpg.interfaces import Environment, NonFiniteError, UserError

LOW, HIGH = [-1.0, 0.0, -3.0, 5.0], [1.0, 10.0, -1.0, 5.0]


class Probe(gymnasium.Env[Any, Any]):
    """Records the actions it gets; answers with what the test puts into its fields."""

    observation_space = Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, low: Any = LOW, high: Any = HIGH, dtype: Any = np.float32) -> None:
        self.action_space: Box = Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
        self.actions: list[np.ndarray] = []
        self.first: Any = np.zeros(2)
        self.answer: tuple[Any, Any, Any, Any] = (np.array([1.0, 2.0]), 1.0, False, False)
        self.frame: Any = np.zeros((4, 6, 3), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.first, {}

    def step(self, action: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.actions.append(action)
        return *self.answer, {}

    def render(self) -> Any:
        if isinstance(self.frame, Exception):
            raise self.frame
        return self.frame


def sent(probe: Probe, action: Any) -> np.ndarray:
    mbdpg.envs.wrap(probe).step(np.asarray(action))
    return probe.actions[-1]


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ([-1, -1, -1, -1], LOW),
        ([1, 1, 1, 1], HIGH),
        ([0, 0, 0, 0], [0, 5, -2, 5]),
        ([0.5, 0.5, 0.5, 0.5], [0.5, 7.5, -1.5, 5]),
        ([-9, 1e308, -1.5, 1e308], [-1, 10, -3, 5]),
        ([9, -1e308, 1.5, -1e308], [1, 0, -1, 5]),
    ],
)
def test_actions_are_scaled_to_asymmetric_bounds(action: list[float], expected: list[float]) -> None:
    real = sent(Probe(), action)
    assert real.dtype == np.float32
    np.testing.assert_array_equal(real, np.array(expected, np.float32))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_scaled_actions_never_leave_bounds_that_round_badly(dtype: Any) -> None:
    random = np.random.default_rng(0)
    bounds = np.sort(random.normal(size=(2, 2000)) * 10.0 ** random.integers(-6, 6, 2000), axis=0)
    probe = Probe(bounds[0], bounds[1], dtype)
    low, high = (bound.astype(np.float64) for bound in (probe.action_space.low, probe.action_space.high))
    for action in (-np.ones(2000), np.ones(2000), random.uniform(-1, 1, 2000)):
        real = sent(probe, action)
        assert real.dtype == dtype
        assert (real >= low).all()
        assert (real <= high).all()
        np.testing.assert_allclose(real, low + (action + 1) / 2 * (high - low), rtol=1e-6, atol=1e-6 * abs(high).max())


def test_scaling_leaves_the_callers_action_alone() -> None:
    action = np.array([3.0, 3.0, 3.0, 3.0])
    sent(Probe(), action)
    np.testing.assert_array_equal(action, 3.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_is_refused_before_the_step(bad: float) -> None:
    probe = Probe()
    with pytest.raises(UserError, match=r"not stepped: the policy's action has entry 2 = (nan|inf|-inf), expected"):
        mbdpg.envs.wrap(probe).step(np.array([0, 0, bad, 0], np.float32))
    assert probe.actions == []


@pytest.mark.parametrize("shape", [(3,), (1, 4), ()])
def test_an_action_of_another_shape_is_refused_before_the_step(shape: tuple[int, ...]) -> None:
    probe = Probe()
    with pytest.raises(UserError, match=r"the policy's action has the shape .*, expected \(4,\)$"):
        mbdpg.envs.wrap(probe).step(np.zeros(shape))
    assert probe.actions == []


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_observation_or_reward_that_is_not_finite_is_an_error(bad: float) -> None:
    probe = Probe()
    env = mbdpg.envs.wrap(probe, name="mine")
    probe.answer = (np.array([0.0, bad]), 1.0, False, False)
    with pytest.raises(NonFiniteError, match=rf"^mine returned observation entry 1 = {bad}$"):
        env.step(np.zeros(4))
    probe.answer = (np.zeros(2), bad, False, False)
    with pytest.raises(NonFiniteError, match=rf"^mine returned the reward {bad}$"):
        env.step(np.zeros(4))
    probe.first = np.array([bad, 0.0])
    with pytest.raises(NonFiniteError, match=rf"^mine returned observation entry 0 = {bad}$"):
        env.reset(seed=0)


def test_an_observation_of_another_shape_is_an_error() -> None:
    probe = Probe()
    probe.answer = (np.zeros(3), 1.0, False, False)
    with pytest.raises(UserError, match=r"shape \(3,\), but its observation_space says \(2,\)"):
        mbdpg.envs.wrap(probe).step(np.zeros(4))


def test_observations_are_contiguous_float32_copies() -> None:
    probe = Probe()
    reused = np.array([[1.0, 9.0], [2.0, 9.0]], np.float32)
    probe.first, probe.answer = reused[::-1, 0], (reused[:, 0], np.float64(1.5), np.True_, np.False_)
    env = mbdpg.envs.wrap(probe)
    first, step = env.reset(seed=0), env.step(np.zeros(4))
    reused[:] = -1
    for observation, expected in ((first, [2, 1]), (step.observation, [1, 2])):
        assert observation.dtype == np.float32
        assert observation.flags.c_contiguous
        np.testing.assert_array_equal(observation, expected)
    assert step[1:] == (1.5, True, False)
    assert [type(value) for value in step[1:]] == [float, bool, bool]


@pytest.mark.parametrize("ends", [(False, False), (True, False), (False, True), (True, True)])
def test_terminated_and_truncated_stay_apart(ends: tuple[bool, bool]) -> None:
    probe = Probe()
    probe.answer = (np.zeros(2), 0.0, *ends)
    step = mbdpg.envs.wrap(probe).step(np.zeros(4))
    assert (step.terminated, step.truncated) == ends


def test_what_the_environment_raises_comes_through() -> None:
    class Broken(Probe):
        def step(self, action: np.ndarray) -> Any:
            raise ZeroDivisionError("mine")

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            raise KeyError("mine too")

    env = mbdpg.envs.wrap(Broken())
    with pytest.raises(ZeroDivisionError, match=r"^mine$"):
        env.step(np.zeros(4))
    with pytest.raises(KeyError, match="mine too"):
        env.reset(seed=0)


def test_frames_are_contiguous_and_checked() -> None:
    probe = Probe()
    env = mbdpg.envs.wrap(probe)
    with pytest.raises(UserError, match="render_mode=None, expected 'rgb_array'"):
        env.render()
    probe.render_mode = "rgb_array"
    probe.frame = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)[::-1]
    frame = env.render()
    assert frame.flags.c_contiguous
    np.testing.assert_array_equal(frame, probe.frame)
    bad: Any
    for bad in (None, [], np.zeros((4, 6, 4), np.uint8), np.zeros((4, 6, 3)), np.zeros((4, 6), np.uint8)):
        probe.frame = bad
        with pytest.raises(UserError, match=r"rendered .*, expected uint8 \(height, width, 3\)"):
            env.render()


def test_mujoco_that_cannot_draw_says_what_to_install() -> None:
    failing = type("Hopper", (Probe,), {"__module__": "gymnasium.envs.mujoco.hopper_v5"})()
    failing.render_mode, failing.frame = "rgb_array", AttributeError("no\nopengl_context")
    with pytest.raises(UserError, match=r"no opengl_context.*MUJOCO_GL=egl.*libegl1.*osmesa.*libosmesa6"):
        mbdpg.envs.wrap(failing).render()
    failing.frame = gymnasium.error.ResetNeeded("reset first")
    with pytest.raises(gymnasium.error.ResetNeeded):
        mbdpg.envs.wrap(failing).render()


def test_other_environments_raise_their_own_errors_in_render() -> None:
    probe = Probe()
    probe.render_mode, probe.frame = "rgb_array", AttributeError("mine")
    with pytest.raises(AttributeError, match=r"^mine$"):
        mbdpg.envs.wrap(probe).render()
    probe.frame = gymnasium.error.DependencyNotInstalled("pygame is missing")
    with pytest.raises(UserError, match=r"pygame is missing.*pip install"):
        mbdpg.envs.wrap(probe).render()


@pytest.mark.parametrize(("libraries", "back_end"), [("EGL OSMesa", "egl"), ("OSMesa", "osmesa"), ("", "")])
def test_frames_without_a_display(monkeypatch: pytest.MonkeyPatch, libraries: str, back_end: str) -> None:
    monkeypatch.setattr("ctypes.util.find_library", lambda name: name if name in libraries.split() else None)
    for variable in ("DISPLAY", "MUJOCO_GL", "SDL_VIDEODRIVER"):
        monkeypatch.setenv(variable, "")
    env = mbdpg.envs.make("BipedalWalker-v3", render=True)
    assert (os.environ["MUJOCO_GL"], os.environ["SDL_VIDEODRIVER"]) == (back_end, "dummy")
    env.reset(seed=0)
    frame = env.render()
    assert frame.dtype == np.uint8
    assert frame.shape == (400, 600, 3)
    assert frame.std() > 10  # a picture, not one colour
    env.close()


@pytest.mark.parametrize(("variable", "value"), [("DISPLAY", ":0"), ("MUJOCO_GL", "osmesa")])
def test_the_users_choice_of_display_and_back_end_stands(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str
) -> None:
    for name in ("DISPLAY", "MUJOCO_GL", "SDL_VIDEODRIVER"):
        monkeypatch.setenv(name, "")
    monkeypatch.setenv(variable, value)
    mbdpg.envs.make("Pendulum-v1", render=True)
    assert os.environ["MUJOCO_GL"] == ("osmesa" if variable == "MUJOCO_GL" else "")


def episode(env: Environment, seed: int, steps: int = 100) -> list[Any]:
    """Everything that an episode of random actions returns."""
    random = np.random.default_rng(seed)
    seen: list[Any] = [env.reset(seed=seed).tolist()]
    for _ in range(steps):
        step = env.step(random.uniform(-1, 1, env.spec.action_size))
        seen.append((step.observation.tolist(), *step[1:]))
        if step.terminated or step.truncated:
            break
    return seen


def differing_seeds(used: Environment, make_fresh: Callable[[], Environment]) -> list[int]:
    """The seeds whose episode in `used` differs from a fresh environment's."""
    for seed in range(100, 110):  # the fault of BipedalWalker shows after 3 episodes, of its Hardcore after 10
        episode(used, seed, steps=2)
    return [seed for seed in range(6) if episode(used, seed) != episode(make_fresh(), seed)]


WALKERS = ["BipedalWalker-v3", "BipedalWalkerHardcore-v3"]


@pytest.mark.parametrize("env_id", [*WALKERS, "LunarLanderContinuous-v3", "HalfCheetah-v5", "Hopper-v5"])
def test_a_used_environment_repeats_a_fresh_one(env_id: str) -> None:
    assert differing_seeds(mbdpg.envs.make(env_id), lambda: mbdpg.envs.make(env_id)) == []


def test_bipedal_walker_made_in_code_is_mended_too() -> None:
    mbdpg.envs.make("BipedalWalker-v3")  # imports Box2D, holding back its warnings

    def from_code() -> Environment:
        return mbdpg.envs.wrap(gymnasium.make("BipedalWalker-v3"))

    assert differing_seeds(from_code(), from_code) == []


@pytest.mark.parametrize("env_id", WALKERS)
def test_bipedal_walker_still_needs_its_mend(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """If this fails, upstream has mended its reset, and FreshWorld can go."""
    monkeypatch.setattr(FreshWorld, "reset", gymnasium.Wrapper.reset)
    assert differing_seeds(mbdpg.envs.make(env_id), lambda: mbdpg.envs.make(env_id)) != []
