"""D_env of Algorithm 1: every environment step of a run, kept in NumPy on the host."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mbdpg.interfaces import Batch, Sampling, Statistics, UserError

CONSTANT = 1e-6
"""An observation entry with a smaller standard deviation never changes (Ant's unused contact forces)."""

HELD_OUT = 5
"""Every so many-th step is held out from learning where an agent asks for it."""

BEFORE_END = 50
"""Last steps of an episode that terminated, its end included, that can outlast those around them."""

LARGEST = float(np.finfo(np.float32).max)


class Replay:
    """Transitions in the order they happened, growing; nothing is ever forgotten.

    A row is one environment step. Rows of one episode are adjacent; `start` is the row of an episode's first step.
    """

    def __init__(self, observation_size: int, action_size: int, *, capacity: int = 1024):
        """Make an empty replay; `capacity` rows are allocated at first and doubled when full."""
        self.size = 0
        self.demonstrated = 0
        """The first rows that come from demonstrations, not from this run's environment."""
        self._columns = {
            "observation": np.zeros((capacity, observation_size), np.float32),
            "action": np.zeros((capacity, action_size), np.float32),
            "reward": np.zeros(capacity, np.float32),
            "next_observation": np.zeros((capacity, observation_size), np.float32),
            "terminated": np.zeros(capacity, np.bool_),
            "truncated": np.zeros(capacity, np.bool_),
            "start": np.zeros(capacity, np.int64),
        }
        self._moments = _Moments(observation_size)

    def add(
        self,
        observation: np.ndarray,
        action: np.ndarray,
        reward: float | np.floating,
        next_observation: np.ndarray,
        terminated: bool | np.bool_,
        truncated: bool | np.bool_,
    ) -> None:
        """Append one step, in raw units.

        Raises:
            ValueError: a value is not finite.
        """
        # As float32, in which it is kept: a float64 beyond its range would become an infinity.
        values = (observation, action, next_observation)
        if not (abs(float(reward)) <= LARGEST and all((np.abs(value) <= LARGEST).all() for value in values)):
            raise ValueError("a transition with a value that is not finite was offered to the replay")
        if self.size == len(self._columns["reward"]):
            self._columns = {name: np.concatenate([x, np.zeros_like(x)]) for name, x in self._columns.items()}
        row, columns = self.size, self._columns
        columns["observation"][row] = observation
        columns["action"][row] = action
        columns["reward"][row] = reward
        columns["next_observation"][row] = next_observation
        columns["terminated"][row] = terminated
        columns["truncated"][row] = truncated
        columns["start"][row] = columns["start"][row - 1] if self.episode_open else row
        self.size += 1
        # The moments see the float32 that is kept, so that a rebuilt replay has the same ones.
        self._moments.add(
            columns["observation"][row], columns["next_observation"][row], columns["reward"][row], terminated
        )

    @property
    def episode_open(self) -> bool:
        """Whether the last row's episode goes on."""
        last = self.size - 1
        return self.size > 0 and not (self._columns["terminated"][last] or self._columns["truncated"][last])

    def columns(self) -> dict[str, np.ndarray]:
        """Views of the filled rows, for a checkpoint."""
        return {name: column[: self.size] for name, column in self._columns.items()}

    @classmethod
    def from_columns(cls, columns: Mapping[str, np.ndarray]) -> Replay:
        """Rebuild a replay, to the last bit of its statistics, from what `columns` gave.

        Raises:
            UserError: the columns are not those of a replay.
        """
        problem = _problem_with(columns)
        if problem:
            raise UserError(f"these are not the steps of a run or of demonstrations: {problem}")
        replay = cls(columns["observation"].shape[1], columns["action"].shape[1])
        try:
            replay.extend(columns)
        except ValueError as error:
            raise UserError(f"these are not the steps of a run or of demonstrations: {error}") from error
        return replay

    def extend(self, columns: Mapping[str, np.ndarray]) -> None:
        """Append the steps of another replay's columns; an open episode before them is closed as truncated."""
        self.close_episode()
        names = ("observation", "action", "reward", "next_observation", "terminated", "truncated")
        base, starts = self.size, columns["start"]
        for i, row in enumerate(zip(*(columns[name] for name in names), strict=True)):
            self.add(*row)
            # An episode that a fault cut short has no mark but the next one's start.
            self._columns["start"][base + i] = base + starts[i]

    def close_episode(self) -> None:
        """Mark the last step as truncated (an episode that cannot go on)."""
        if self.episode_open:
            self._columns["truncated"][self.size - 1] = True

    def open_episode(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Observations, actions and next observations of the episode that has not ended yet."""
        first = int(self._columns["start"][self.size - 1]) if self.episode_open else self.size
        rows = slice(first, self.size)
        c = self._columns
        return c["observation"][rows], c["action"][rows], c["next_observation"][rows]

    def sample(self, updates: int, sampling: Sampling, rng: np.random.Generator) -> Batch:
        """Draw windows around uniformly drawn steps: arrays of shape (updates, batch, burn_in + length, ...)."""
        rows = self.demonstrated if sampling.demonstrated else self.size
        held_out = rows // HELD_OUT
        count = {"all": rows, "kept": rows - held_out, "held-out": max(held_out, 1)}[sampling.part]
        oldest = max(rows - sampling.newest, 0) if sampling.newest else 0
        older = self._before_terminations(oldest, sampling.terminations)
        drawn = rng.integers(oldest - older.size, count, (updates, sampling.batch_size))
        if older.size:
            drawn = np.where(drawn < oldest, older[np.minimum(drawn - oldest, -1)], drawn)
        if sampling.part == "kept":
            drawn += drawn // (HELD_OUT - 1)
        elif sampling.part == "held-out":
            drawn = np.minimum(drawn * HELD_OUT + HELD_OUT - 1, rows - 1)
        return self.windows(drawn, sampling)

    def _before_terminations(self, oldest: int, count: int) -> np.ndarray:
        """The last rows before each of the newest `count` terminations, those from row `oldest` on left out."""
        ends = np.flatnonzero(self._columns["terminated"][: self.size])[-count:] if count else np.zeros(0, np.int64)
        rows = (ends[:, None] - np.arange(BEFORE_END)[::-1]).ravel()
        return rows[(rows >= np.repeat(self._columns["start"][ends], BEFORE_END)) & (rows < oldest)]

    def windows(self, row: np.ndarray, sampling: Sampling) -> Batch:
        """The steps around each given row; those outside its episode repeat the row itself and are not `valid`."""
        c, row = self._columns, row[..., None]
        wanted = row + np.arange(-sampling.burn_in, sampling.length)
        rows = np.clip(wanted, 0, self.size - 1)
        valid = (c["start"][rows] == c["start"][row]) & (wanted == rows)
        rows = np.where(valid, rows, row)
        return Batch(
            observation=c["observation"][rows],
            action=c["action"][rows],
            reward=c["reward"][rows],
            next_observation=c["next_observation"][rows],
            terminated=c["terminated"][rows].astype(np.float32),
            valid=valid.astype(np.float32),
        )

    def statistics(self, progress: float) -> Statistics:
        """Moments of all steps so far, as float32."""
        return self._moments.statistics(progress, self.size - self.demonstrated)


def _problem_with(columns: Mapping[str, np.ndarray]) -> str | None:
    """What keeps columns, perhaps a stranger's, from being a replay's; None if nothing does."""
    wanted = {name: (column.dtype, column.ndim) for name, column in Replay(1, 1, capacity=1).columns().items()}
    found = {name: (column.dtype, column.ndim) for name, column in columns.items()}
    for name, kind in wanted.items():
        if found.get(name) != kind:
            return f"{name} is {found.get(name, 'missing')}, expected {kind[0]} of {kind[1]} axes"
    rows = len(columns["reward"])
    if any(len(columns[name]) != rows for name in wanted):
        return "the columns have different lengths"
    if columns["observation"].shape != columns["next_observation"].shape or columns["observation"].shape[1] > 10**6:
        return f"observations of shape {columns['observation'].shape} and {columns['next_observation'].shape}"
    # An episode starts at its own row or goes on from the one before, which must not have ended.
    start, row = columns["start"], np.arange(rows)
    before = np.concatenate([[-1], start[:-1]])
    over = np.concatenate([[True], (columns["terminated"] | columns["truncated"])[:-1]])
    if not np.where(over, start == row, (start == row) | (start == before)).all():
        return "episodes do not begin where the ones before end"
    return None


class _Moments:
    """Running sums in float64; added row by row, so that a rebuilt replay has the same ones."""

    def __init__(self, observation_size: int):
        self._count = 0
        self._terminal_count = 0
        # Counted from the first one, so that the variance of what never changes is 0 and not a rounding error.
        self._origin = np.zeros(observation_size)
        # Sums of the observation, its square, its change and the square of that; then of rewards.
        self._observation = np.zeros((4, observation_size))
        self._reward = np.zeros(4)

    def add(
        self, observation: np.ndarray, after: np.ndarray, reward32: np.float32, terminated: bool | np.bool_
    ) -> None:
        x, reward = observation.astype(np.float64), float(reward32)
        d = after - x
        if self._count == 0:
            self._origin = x
        x = x - self._origin
        self._count += 1
        self._observation += np.stack([x, x * x, d, d * d])
        self._reward[0] += reward * reward
        if terminated:
            self._terminal_count += 1
            self._reward[1] += reward * reward
        else:
            self._reward[2] += reward
            self._reward[3] += reward * reward

    def statistics(self, progress: float, steps: int) -> Statistics:
        n = max(self._count, 1)
        mean, square, change, change_square = self._observation / n
        alive = max(self._count - self._terminal_count, 1)
        reward_mean = self._reward[2] / alive
        reward_variance = max(self._reward[3] / alive - reward_mean**2, 0.0)
        terminal = np.sqrt(self._reward[1] / self._terminal_count) if self._terminal_count else 1.0
        return Statistics(
            observation_mean=(self._origin + mean).astype(np.float32),
            observation_std=_spread(square - mean**2),
            delta_std=_spread(change_square - change**2),
            reward_std=_spread(np.asarray(reward_variance)),
            terminal_reward_scale=np.float32(terminal if terminal > CONSTANT else 1.0),
            return_scale=_spread(np.asarray(self._reward[0] / n)),
            progress=np.float32(progress),
            steps=np.float32(steps),
        )


def _spread(variance: np.ndarray) -> np.ndarray:
    """Standard deviations, 1 for what never changes."""
    std = np.sqrt(np.maximum(variance, 0.0))
    return np.where(std < CONSTANT, 1.0, std).astype(np.float32)
