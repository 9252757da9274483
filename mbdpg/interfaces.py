"""Words every room uses: what an environment is, what an agent must offer, what a run records.

Axes, in this order wherever they occur: ``seed, batch, time, feature``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import (
    Any,
    Literal,
    NamedTuple,
    Protocol,
    get_args,
    get_origin,
    get_type_hints,
    runtime_checkable,
)

import numpy as np

Metrics = dict[str, Any]
"""Names as in docs/metrics.md, to numbers or lists of them (under jit, scalar arrays)."""


class UserError(Exception):
    """Something the person at the keyboard can mend; its text is one line: what was wrong, expected, to do."""


def require(condition: bool, message: str) -> None:
    """Raise `UserError(message)` unless the condition holds."""
    if not condition:
        raise UserError(message)


def one_line(text: str) -> str:
    """Text without line breaks, cut where nobody reads on."""
    return " ".join(text.split())[:500]


def flag_of(setting: str) -> str:
    """The command line's flag for a setting."""
    return "--" + setting.replace("_", "-")


def as_flag(setting: str, value: Any) -> list[str]:
    """What to type for a setting's value."""
    if isinstance(value, bool):
        return [flag_of(setting if value else f"no_{setting}")]
    return [flag_of(setting), str(value)]


def require_settings(
    config: Any, *, positive: Sequence[str] = (), at_most: Mapping[str, float] = {}, signed: Sequence[str] = ()
) -> None:
    """Check a config's choices, and its numbers: above 0, up to a bound, finite, or else at least 0.

    Learning rates are at most 1 and rates of updates at most 1,000: beyond, a typing error is likelier than a purpose.
    """
    kinds = get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value, kind = getattr(config, field.name), kinds[field.name]
        flag = flag_of(field.name)
        if get_origin(kind) is Literal:
            choices = get_args(kind)
            require(value in choices, f"{flag} is {value!r}, expected one of {', '.join(map(str, choices))}")
            continue
        wanted = (int, float) if kind is float else kind
        fits = isinstance(value, wanted) and isinstance(value, bool) == (kind is bool)
        require(fits, f"{flag} is {value!r}, expected {kind.__name__}")
        require(math.isfinite(value), f"{flag} is {value}, expected a finite number")
        if field.name in signed:
            continue
        implied = {"learning_rate": 1.0, "updates_per_step": 1000.0, "fits_per_step": 1000.0}
        bound = at_most.get(field.name) or next((x for end, x in implied.items() if field.name.endswith(end)), math.inf)
        fits = value > 0 if field.name in positive else value >= 0
        least = "above 0" if field.name in positive else "of at least 0" if bound == math.inf else "from 0"
        most = "" if bound == math.inf else f" to {bound:g}" if field.name not in positive else f", at most {bound:g}"
        require(fits and value <= bound, f"{flag} is {value}, expected a number {least}{most}")


class NonFiniteError(Exception):
    """The environment returned NaN or an infinity; the transition must not reach the replay."""


@dataclass(frozen=True)
class EnvSpec:
    """What an environment tells the rest of the system."""

    id: str
    """Gymnasium id, or a name for an environment made in code."""
    observation_size: int
    action_size: int
    episode_limit: int | None
    """Steps after which an episode is truncated; None if it never is."""
    reference_return: float | None
    """Return at which the task counts as solved (environment steps' undiscounted sum); None if nobody says."""


class Step(NamedTuple):
    """One environment step; `terminated` and `truncated` are never merged."""

    observation: np.ndarray
    """float32, shape (observation_size,)."""
    reward: float
    terminated: bool
    truncated: bool


@runtime_checkable
class Environment(Protocol):
    """One environment with actions in [-1, 1] and float32 observations (see `mbdpg.envs.make`)."""

    spec: EnvSpec

    def reset(self, *, seed: int) -> np.ndarray: ...

    def step(self, action: np.ndarray) -> Step: ...

    def render(self) -> np.ndarray: ...

    def close(self) -> None: ...


@runtime_checkable
class Acting(Protocol):
    """A policy on the host, for one environment."""

    arrays: dict[str, np.ndarray]
    """What it is made of, by name: the content of a policy file."""
    memory: list[float]
    """What it carries from one step to the next; a checkpoint holds it, so that a resumed run goes on with it."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The action, in [-1, 1], for a raw observation."""

    def explore(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """An action to learn from, given noise of the action's shape."""

    def reset(self) -> None:
        """A new episode begins."""


class Batch(NamedTuple):
    """Windows of consecutive environment steps in raw units, float32; `valid` marks steps inside the episode."""

    observation: Any
    """Shape (..., batch, time, observation)."""
    action: Any
    """Shape (..., batch, time, action), in [-1, 1]."""
    reward: Any
    """Shape (..., batch, time)."""
    next_observation: Any
    """Shape (..., batch, time, observation)."""
    terminated: Any
    """Shape (..., batch, time); 1 where the task ended. A time limit is not an end."""
    valid: Any
    """Shape (..., batch, time); 0 before the episode's start and after its end."""


Part = Literal["all", "kept", "held-out"]
"""Which steps of a replay: all, or but for every fifth, or every fifth alone."""


class Sampling(NamedTuple):
    """What an update is fed: `batch_size` windows of `burn_in` past steps, then `length` steps from a drawn one."""

    batch_size: int
    burn_in: int
    length: int
    demonstrated: bool = False
    """Draw from demonstrations alone."""
    part: Part = "all"
    """Where the drawn steps are."""
    newest: int = 0
    """Draw from so many of the newest steps alone; 0: from all."""
    terminations: int = 0
    """Beside the newest steps, draw from the last ones before so many of the newest terminations."""


class Statistics(NamedTuple):
    """Moments of everything in a replay, and how far learning has come; raw units."""

    observation_mean: Any
    """Shape (observation,)."""
    observation_std: Any
    """Shape (observation,); 1 where an entry never changes."""
    delta_std: Any
    """Shape (observation,); standard deviation of the change in one step, 1 where an entry never changes."""
    reward_std: Any
    """Of rewards of steps that did not terminate."""
    terminal_reward_scale: Any
    """Root mean square of rewards of steps that terminated; 1 if none did."""
    return_scale: Any
    """Root mean square of all rewards; the unit of values."""
    progress: Any
    """0 while recent training returns are a random policy's, 1 once they reach the reference return."""
    steps: Any
    """How many steps there are, those of demonstrations aside."""


class Phase(NamedTuple):
    """One kind of gradient step of an agent, and how often and on what it is taken."""

    name: str
    """As in `fitting` or `improving`; `time/<name>` counts its seconds."""
    updates_per_step: float
    """Gradient steps per environment step after the random ones."""
    sampling: Sampling
    first_updates: int = 0
    """Gradient steps taken at once after the random environment steps, rounded up to as many as one call takes."""
    update: Callable[..., tuple[Any, Metrics]] = lambda state, batch, *, key: (state, {})
    """update(state, batch, *, key) -> (state, metrics): pure, for one seed, traced by JAX."""


@runtime_checkable
class Agent(Protocol):
    """What the training loop knows of an algorithm. States are pytrees of arrays; functions are pure, for one seed."""

    @property
    def config(self) -> Any:
        """Its own Config; every one has `discount`, `random_steps`, `exploration_color` and `exploration_scatter`."""

    @property
    def env(self) -> EnvSpec: ...

    @property
    def phases(self) -> Sequence[Phase]: ...

    def init(self, *, key: Any) -> Any:
        """A fresh state."""

    def prepare(self, state: Any, statistics: Statistics) -> Any:
        """The state with its scaling (and what follows from progress) set from the replay."""

    def policy(self, state: Any) -> tuple[Any, Any]:
        """What has been learned: the deterministic policy that is evaluated and saved, and its normalizer."""

    def behavior(self, state: Any) -> tuple[Any, Any, Any]:
        """What collects experience: a policy, its normalizer, and the standard deviation of the noise it is given.

        The last is the mean over episodes: for a deterministic policy in units of half the action range, for a Gaussian
        one in standard deviations of its own.
        """

    def diagnose(self, state: Any, batch: Batch, realized_return: Any) -> Metrics:
        """Instruments on evaluation episodes that learning has never seen; sampled as `diagnosis` says.

        Args:
            state: the agent's.
            batch: windows of evaluation steps, shape (batch, time, ...).
            realized_return: discounted return that followed each window's first step, NaN where it is not known.
        """

    @property
    def diagnosis(self) -> Sampling: ...


def phase_of(agent: Agent, name: str) -> Phase:
    """An agent's phase by its name."""
    return next(phase for phase in agent.phases if phase.name == name)
