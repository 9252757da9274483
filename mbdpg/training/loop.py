"""Algorithm 1 as a training loop, for any agent and several seeds at once."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from mbdpg.envs import episode_seed
from mbdpg.interfaces import Acting, Environment, Metrics, Phase, flag_of, require, require_settings
from mbdpg.training.collector import Collector
from mbdpg.training.evaluation import Evaluation, StoppedError, diagnosis_windows, evaluate
from mbdpg.training.learner import Learner
from mbdpg.training.randomness import random_stream


@dataclass(frozen=True)
class Schedule:
    """How long a run is and how often it looks up from learning; all in environment steps."""

    steps: int = 100_000
    """Environment steps of the whole run."""
    cycle: int = 50
    """Environment steps collected between two rounds of updates."""
    evaluate_every: int = 5_000
    """Environment steps between two evaluations."""
    evaluation_episodes: int = 5
    """Episodes of the deterministic policy per evaluation; their steps are not learned from and not counted."""
    log_every: int = 1_000
    """Environment steps between two rows of training metrics."""
    checkpoint_every: int = 10_000
    """Environment steps between two checkpoints."""

    def __post_init__(self) -> None:
        names = ("steps", "cycle", "evaluate_every", "evaluation_episodes", "log_every", "checkpoint_every")
        require_settings(self, positive=names)
        for name in ("steps", "evaluate_every", "log_every", "checkpoint_every"):
            value = getattr(self, name)
            whole = value % self.cycle == 0
            require(whole, f"{flag_of(name)} is {value}, expected a multiple of --cycle, {self.cycle}")


class Update(NamedTuple):
    """What the loop tells whoever watches, after each cycle."""

    env_steps: int
    train_returns: list[float]
    """Last finished training episode of each seed; NaN before the first."""
    evaluation: list[Evaluation] | None
    """One per seed, when there was one."""


@runtime_checkable
class Recorder(Protocol):
    """Where one seed's run is written."""

    def write(self, kind: str, env_steps: int, values: Metrics) -> None: ...

    def save_policy(self, arrays: dict[str, np.ndarray], env_steps: int, return_mean: float) -> None: ...

    def save_checkpoint(
        self, env_steps: int, arrays: dict[str, np.ndarray], facts: dict[str, Any], replay: dict[str, np.ndarray]
    ) -> None: ...


class Training:
    """A run of one agent over several seeds in lockstep; `run` is Algorithm 1."""

    def __init__(
        self,
        learner: Learner,
        collectors: Sequence[Collector],
        make_env: Callable[[], Environment],
        recorders: Sequence[Recorder],
        schedule: Schedule,
        *,
        expert_env_steps: int = 0,
    ):
        """Put the parts of a run together; each seed has a collector and a recorder, in the learner's order."""
        self.learner = learner
        self.collectors = collectors
        self.schedule = schedule
        self.env_steps = 0
        self._make_env = make_env
        self._recorders = recorders
        self._expert_env_steps = expert_env_steps
        self._updates = {phase.name: 0 for phase in learner.agent.phases}
        self._recorded = -1
        self._ended = -1
        self._saved: tuple[int, ...] = ()
        self._sums: list[dict[str, list[float]]] = [{} for _ in collectors]
        self._seconds = {"acting": 0.0, "evaluating": 0.0} | {phase.name: 0.0 for phase in learner.agent.phases}
        self._began = time.monotonic()
        self._before = [dict.fromkeys(("seconds", *self._seconds), 0.0) for _ in collectors]

    def run(self, on_update: Callable[[Update], None], should_stop: Callable[[], bool]) -> None:
        """Learn, record and collect until the last step, or until asked to stop; then save.

        A stop may come between any two calls of an update: what is due at a step is a function of the step, so a
        resumed run first takes the updates that are missing and goes on as if nothing had happened.
        """
        with contextlib.suppress(StoppedError):
            while self._learn(should_stop):
                policies, stds = self.learner.behaviors()
                if self._recorded < self.env_steps or self._ended < self.env_steps == self.schedule.steps:
                    on_update(self._record(stds, should_stop))
                if self.env_steps >= self.schedule.steps or should_stop():
                    break
                self._collect(policies, stds)  # Algorithm 1, line 5
        if self._saved != (self.env_steps, *self._updates.values()):
            self.save()

    def save(self) -> None:
        """Write every seed's checkpoint."""
        self._saved = (self.env_steps, *self._updates.values())
        for index, (collector, recorder) in enumerate(zip(self.collectors, self._recorders, strict=True)):
            facts: dict[str, Any] = {
                "collector": collector.facts(),
                "updates": self._updates,
                "sums": self._sums[index],
            }
            facts |= {
                "steps": self.schedule.steps,
                "recorded": self._recorded,
                "ended": self._ended,
                "expert_env_steps": self._expert_env_steps,
                "demonstrated": collector.replay.demonstrated,
                "clock": self._clock(index),
            }
            recorder.save_checkpoint(self.env_steps, self.learner.snapshot(index), facts, collector.replay.columns())

    def restore(self, env_steps: int, arrays: Sequence[dict[str, np.ndarray]], facts: Sequence[dict[str, Any]]) -> None:
        """Go on where `save` was called; the collectors' replays are restored already."""
        self.env_steps = env_steps
        self.learner.restore(arrays)
        self._updates = {name: int(facts[0]["updates"][name]) for name in self._updates}
        require(min(self._updates.values()) >= 0, "the checkpoint counts fewer than no updates")
        self._recorded = facts[0]["recorded"]
        self._ended = facts[0]["ended"]
        self._expert_env_steps = facts[0]["expert_env_steps"]
        self._sums = [dict(fact["sums"]) for fact in facts]
        self._before = [{name: float(fact["clock"][f"time/{name}"]) for name in self._before[0]} for fact in facts]
        for collector, fact in zip(self.collectors, facts, strict=True):
            collector.restore(fact["collector"])

    def _record(self, stds: np.ndarray, should_stop: Callable[[], bool]) -> Update:
        """Evaluate, log and save, each if it is due at this step.

        A run that was to go on, and is now to end where it stands, comes here a second time.
        """
        schedule = self.schedule
        evaluation = self._evaluate(should_stop) if self._due(schedule.evaluate_every) else None
        log, save = self._due(schedule.log_every), self._due(schedule.checkpoint_every)
        self._recorded = self.env_steps
        if self.env_steps == schedule.steps:
            self._ended = self.env_steps
        if log:
            self._log(stds)
        if save:
            self.save()
        return Update(self.env_steps, [(c.returns or [np.nan])[-1] for c in self.collectors], evaluation)

    def _due(self, every: int) -> bool:
        if self.env_steps % every == 0:
            return self._recorded < self.env_steps
        return self.env_steps == self.schedule.steps

    def _collect(self, policies: Sequence[Acting], stds: np.ndarray) -> None:
        began = time.monotonic()
        for collector, policy, std in zip(self.collectors, policies, stds, strict=True):
            collector.collect(policy, float(std), self.schedule.cycle)
        self.env_steps += self.schedule.cycle
        self._seconds["acting"] += time.monotonic() - began

    def _learn(self, should_stop: Callable[[], bool]) -> bool:
        """Take all updates that are due (Algorithm 1, lines 3 and 6-16); False if asked to stop before the last."""
        agent = self.learner.agent
        if self.env_steps < agent.config.random_steps or not all(c.replay.size for c in self.collectors):
            return True
        progress = [c.progress(agent.env.reference_return) for c in self.collectors]
        self.learner.prepare([c.replay.statistics(p) for c, p in zip(self.collectors, progress, strict=True)])
        return all(self._take(phase, should_stop) for phase in agent.phases)

    def _take(self, phase: Phase, should_stop: Callable[[], bool]) -> bool:
        """Take a phase's updates that are due, always as many per call, so that it is compiled once."""
        if phase.sampling.demonstrated and not self.collectors[0].replay.demonstrated:
            return True
        began, cycle, rate = time.monotonic(), self.schedule.cycle, phase.updates_per_step
        # At rate 0 nothing comes after the first updates, so calls of a size that leaves none of them over.
        chunk = max(1, round(rate * cycle)) if rate else math.gcd(phase.first_updates, cycle)
        first = math.ceil(phase.first_updates / chunk) * chunk
        # Rounded first: 50 * 0.58 is a little less than 29, and would leave a cycle's updates to the next one.
        due = first + int(round((self.env_steps - self.learner.agent.config.random_steps) * rate, 6))
        while (done := self._updates[phase.name]) + chunk <= due and not should_stop():
            batches = [
                c.replay.sample(chunk, phase.sampling, random_stream(c.seed, phase.name, done)) for c in self.collectors
            ]
            self._accumulate(self.learner.update(phase, batches, done))
            self._updates[phase.name] += chunk
        self._seconds[phase.name] += time.monotonic() - began
        return done + chunk > due

    def _accumulate(self, metrics: Metrics) -> None:
        for index, sums in enumerate(self._sums):
            for name, values in metrics.items():
                total, count = sums.get(name, (0.0, 0))
                sums[name] = [total + float(values[index]), count + 1]

    def _evaluate(self, should_stop: Callable[[], bool]) -> list[Evaluation]:
        began = time.monotonic()
        policies, evaluations = self.learner.policies(), []
        for collector, policy in zip(self.collectors, policies, strict=True):
            # The same episodes for every agent and at every evaluation: paired, so that differences are the policies'.
            seeds = [
                episode_seed(collector.seed, "evaluate", episode)
                for episode in range(self.schedule.evaluation_episodes)
            ]
            # A fresh environment: a resumed run has no used one, and a fault must not outlive its evaluation.
            with contextlib.closing(self._make_env()) as env:
                evaluations.append(evaluate(env, policy, seeds, should_stop=should_stop))
        metrics = self._diagnose(evaluations)
        self._seconds["evaluating"] += time.monotonic() - began
        for index, (recorder, evaluation) in enumerate(zip(self._recorders, evaluations, strict=True)):
            returns = evaluation.returns or [math.nan]  # the environment failed in every episode
            row: Metrics = {
                "eval/return_mean": float(np.mean(returns)),
                "eval/return_std": float(np.std(returns)),
                "eval/returns": evaluation.returns,
                "eval/length_mean": float(np.mean(evaluation.lengths)) if evaluation.lengths else math.nan,
                "eval/faults": evaluation.faults,
                "expert_env_steps": self._expert_env_steps,
            }
            row |= {name: float(values[index]) for name, values in metrics.items()}
            recorder.write("eval", self.env_steps, row | self._clock(index))
            recorder.save_policy(policies[index].arrays, self.env_steps, row["eval/return_mean"])
        return evaluations

    def _diagnose(self, evaluations: Sequence[Evaluation]) -> Metrics:
        """The agent's instruments on evaluation steps, none if a seed has no step."""
        if not all(evaluation.steps.size for evaluation in evaluations):
            return {}
        agent, windows = self.learner.agent, []
        for collector, evaluation in zip(self.collectors, evaluations, strict=True):
            rng = random_stream(collector.seed, "diagnose", self.env_steps)
            windows.append(diagnosis_windows(evaluation.steps, agent.diagnosis, agent.config.discount, rng))
        return self.learner.diagnose([w[0] for w in windows], [w[1] for w in windows])

    def _log(self, stds: np.ndarray) -> None:
        for index, (collector, recorder) in enumerate(zip(self.collectors, self._recorders, strict=True)):
            row: Metrics = {name: total / count for name, (total, count) in self._sums[index].items()}
            row |= {
                "train/episodes": collector.episode,
                "train/faults": collector.faults,
                "exploration/std": float(stds[index]),
                "gradient_steps": sum(self._updates.values()),
            }
            if collector.returns:
                row |= {"train/episode_return": collector.returns[-1], "train/return_mean": collector.recent_return}
            recorder.write("train", self.env_steps, row | self._clock(index))
            self._sums[index] = {}

    def _clock(self, index: int) -> Metrics:
        """Seconds of all processes that worked on a seed, up to the checkpoints it went on from, and their parts."""
        now = {"seconds": time.monotonic() - self._began} | self._seconds
        return {f"time/{name}": before + now[name] for name, before in self._before[index].items()}
