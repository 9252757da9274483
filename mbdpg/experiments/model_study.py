"""How far dynamics models of different kinds predict, trained on the same recorded steps (Fig. 6, 7 and 9a)."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mbdpg.agents.mbdpg import MBDPG, Config
from mbdpg.agents.mbdpg.state import State, optimizers
from mbdpg.dynamics.aggregation import Aggregate, Aggregation
from mbdpg.dynamics.fitting import open_loop_error
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.work import is_made_as, refuse_made_otherwise, say_made_as
from mbdpg.interfaces import Batch, Sampling, phase_of, require
from mbdpg.storage.checkpoint import load_checkpoint
from mbdpg.storage.files import replace_table
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.learner import Learner
from mbdpg.training.replay import Replay

STEPS = 200
"""Open-loop steps over which models are compared, the paper's."""

WINDOWS = 512
"""Starts of such predictions, drawn from the held-out episodes, the same for every model."""

HELD_OUT = 5
"""Every so many-th episode is only tested on."""

PER_CALL = 50
"""Updates per compiled call."""


@final
@dataclass(frozen=True)
class ModelFit:
    """One model, trained and tested; the file with its errors says that it is finished."""

    label: str
    agent: Config
    """Of the agent whose dynamics are trained, as it trains them."""
    updates: int
    """Of the dynamics, for every member."""
    data: Path
    """Run folder whose steps are learned from."""
    data_steps: int
    """Its first so many are learned from and tested on."""
    seed: int
    out: Path
    """CSV file: depth, root mean square error, and that of persistence, in standard deviations of the observation."""
    aggregation: Aggregation = "none"
    members: int = 1

    @property
    def name(self) -> str:
        """Which model, and its seed."""
        return f"{self.label} seed {self.seed}"

    def finished(self) -> bool:
        """Whether its errors are known, of these settings."""
        return is_whole(self.out) and is_made_as(self.out, self._settings())

    def __call__(self, should_stop: Callable[[], bool]) -> None:
        """Do it; stopped, it leaves nothing behind: it takes minutes.

        Raises:
            UserError: there are errors of other settings, or too few steps to learn from.
        """
        refuse_made_otherwise(self.out, self._settings())
        keep_compilations()
        config, steps = RunConfig.of(RunFolder.open(self.data)), Recorded.load(self.data, self.data_steps)
        env = config.make_env()
        agent, rng = MBDPG(self.agent, env.spec), np.random.default_rng(self.seed)
        env.close()
        members: list[Any] = []
        for member in range(self.members):
            learner = Learner(agent, [(1000 * self.seed + member) % 2**31])
            learner.prepare([steps.replay.statistics(0.0)])
            if self.aggregation == "boosting":
                learner.state = _boosted(agent, learner.state, members)
            phase = phase_of(agent, "fitting")
            rows = steps.resampled(rng) if self.aggregation == "bagging" else steps.learned
            for done in range(0, self.updates, PER_CALL):
                if should_stop():
                    return
                count = min(PER_CALL, self.updates - done)
                drawn = rows[rng.integers(0, len(rows), (count, phase.sampling.batch_size))]
                learner.update(phase, [steps.replay.windows(drawn, phase.sampling)], done)
            state = jax.tree.map(lambda leaf: leaf[0], learner.state)
            newest: Any = state.average_dynamics
            members.append(newest.members[-1] if isinstance(newest, Aggregate) else newest)
        model = members[0] if self.aggregation == "none" else Aggregate(tuple(members), self.aggregation)
        self._write(errors(agent, model, state, steps))

    def _settings(self) -> dict[str, Any]:
        given = {name: getattr(self, name) for name in ("updates", "data_steps", "seed", "aggregation", "members")}
        return given | {"agent": dataclasses.asdict(self.agent), "open_loop_steps": STEPS, "windows": WINDOWS}

    def _write(self, found: np.ndarray) -> None:
        rows = [(depth, f"{error:.5g}", f"{still:.5g}") for depth, (error, still) in enumerate(found, start=1)]
        say_made_as(self.out, self._settings())
        replace_table(self.out, [("depth", "rmse", "persistence"), *rows])


def is_whole(file: Path) -> bool:
    """Whether a file of errors is there with all its rows; a model whose file lost some is trained again."""
    text = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    rows = text.splitlines()
    return text.endswith("\n") and len(rows) == STEPS + 1 and all(row.count(",") == 2 for row in rows)


@final
@dataclass(frozen=True)
class Recorded:
    """The steps of a run, by whole episodes either learned from or tested on."""

    replay: Replay
    learned: np.ndarray
    """Rows."""
    tested: np.ndarray
    """Rows that `STEPS` further ones of their episode follow."""

    @classmethod
    def load(cls, run: Path, steps: int) -> Recorded:
        """Read the first so many from the run's newest checkpoint: it may have been trained for longer.

        Raises:
            UserError: there are too few steps, or too few long episodes.
        """
        replay = Replay.from_columns({name: column[:steps] for name, column in load_checkpoint(run).replay.items()})
        saved = f"{run} has saved {replay.size:,} of {steps:,} steps to learn from"
        require(replay.size == steps, f"{saved}; go on with it: mbdpg resume {shlex.quote(str(run))}")
        start = replay.columns()["start"]
        starts, episode = np.unique(start, return_inverse=True)
        held_out = episode % HELD_OUT == HELD_OUT - 1
        ends = np.append(starts[1:], replay.size)[episode]
        tested = np.flatnonzero(held_out & (np.arange(replay.size) + STEPS <= ends))
        require(
            len(tested) > 0,
            f"{run} has no episode of {STEPS} steps to test on (one in {HELD_OUT} is held out); train it for longer",
        )
        return cls(replay, np.flatnonzero(~held_out), tested)

    def resampled(self, rng: np.random.Generator) -> np.ndarray:
        """Rows of as many episodes as are learned from, drawn with replacement: a bootstrap sample."""
        start = self.replay.columns()["start"][self.learned]
        episodes = np.split(self.learned, np.flatnonzero(np.diff(start)) + 1)
        return np.concatenate([episodes[i] for i in rng.integers(0, len(episodes), len(episodes))])


def errors(agent: MBDPG, model: Any, state: State, steps: Recorded) -> np.ndarray:
    """Errors of open-loop prediction and of persistence on held-out episodes, shape (STEPS, 2)."""
    burn_in = agent.config.burn_in
    drawn = steps.tested[np.random.default_rng(0).integers(0, len(steps.tested), WINDOWS)]
    windows = steps.replay.windows(drawn, Sampling(WINDOWS, burn_in, STEPS))

    @jax.jit
    def measure(model: Any, state: State, windows: Batch) -> Array:
        return open_loop_error(model, state.scales, state.window(windows), burn_in=burn_in)

    return np.asarray(measure(model, state, windows))


def _boosted(agent: MBDPG, state: Any, before: list[Any]) -> Any:
    """A fresh state whose dynamics are to be learned on top of what the members before predict."""
    members = [jax.tree.map(lambda leaf: leaf[None], member) for member in before]
    dynamics = Aggregate((*members, state.dynamics), "boosting")
    optimizer = jax.vmap(optimizers(agent.config).dynamics.init)(dynamics)
    return eqx.tree_at(
        lambda s: (s.dynamics, s.average_dynamics, s.dynamics_optimizer),
        state,
        (dynamics, jax.tree.map(jnp.copy, dynamics), optimizer),
    )
