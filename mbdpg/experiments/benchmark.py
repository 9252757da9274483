"""What this machine makes of MBDPG: its updates against their own matrix products, acting, starting, memory.

Every time is the median of a few calls on this machine at this moment; compare what one invocation measured.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from mbdpg.agents import mbdpg
from mbdpg.experiments.compilations import LEAST_SECONDS
from mbdpg.experiments.config import RunConfig
from mbdpg.experiments.origin import machine
from mbdpg.experiments.products import matrix_products, median_seconds, product_seconds
from mbdpg.interfaces import EnvSpec, Phase, phase_of
from mbdpg.training.learner import Learner
from mbdpg.training.replay import Replay

TASK = "HalfCheetah-v5"
SPEC = EnvSpec(TASK, observation_size=17, action_size=6, episode_limit=1000, reference_return=4800.0)
PAPER_SIZES = mbdpg.Config(horizon=20, batch_size=128, fit_batch_size=128, fit_length=10, burn_in=5, gaussians=5)
"""Section 5.1's batch, horizon, training length and networks, with the full gradient, after five real steps."""

ROWS = 2000
"""Made-up environment steps that updates learn from."""
DEFAULTS = mbdpg.Config()
"""What a fresh process starts with."""
REPLAY_ROWS = 200_000
"""Environment steps of a run whose peak memory is measured."""
UPDATES = 4
"""Gradient steps per timed call, in one compiled loop as in training."""
GROWTH = {"horizon": (5, 10, 40), "batch_size": (32, 64, 256), "width": (64, 128, 512), "seeds": (1, 2, 4)}


class Cost(NamedTuple):
    """One update of a kind."""

    ms: float
    gflop: float
    """Of its matrix products, counted from their shapes."""
    attainable_gflops: float
    """Rate of the same products, each repeated by itself."""

    @property
    def share(self) -> float:
        """Of the attainable rate."""
        return self.gflop / (self.ms * 1e-3) / self.attainable_gflops


Say = Callable[[str, str, str], None]
"""Called with every result as it comes: what was measured, its value with the unit, and a remark."""


def benchmark(say: Say, *, growth: bool = True) -> dict[str, Any]:
    """Measure everything; a few minutes.

    Args:
        say: shows a row of the table.
        growth: also time the updates at other sizes and numbers of seeds.

    Returns:
        Numbers by name, for JSON: times in the unit that the name ends with, rates in GFLOP/s, memory in MiB. A
        share is that of the update's own attainable rate; `attainable_gflops` is of improve and fit together. Those
        two are at the paper's sizes, like ground, which the paper has not: 32 windows of 8 real steps.
    """
    result: dict[str, Any] = {}
    costs: dict[str, Cost] = {}
    for name, phase in (("improve", "improving"), ("fit", "fitting"), ("ground", "grounding")):
        cost = costs[name] = cost_of(phase, PAPER_SIZES)
        result |= {f"{name}_ms": cost.ms, f"{name}_gflop": cost.gflop, f"{name}_share": cost.share}
        result[f"{name}_attainable_gflops"] = cost.attainable_gflops
        attained = f"{cost.gflop:.2f} GFLOP at {100 * cost.share:.0f} % of the {cost.attainable_gflops:.0f} GFLOP/s"
        say(f"{name}, one update", f"{cost.ms:.1f} ms", f"{attained} that its matrix products attain by themselves")
    both = costs["improve"], costs["fit"]
    seconds = sum(cost.gflop / cost.attainable_gflops for cost in both)
    result["attainable_gflops"] = sum(cost.gflop for cost in both) / seconds
    result |= _acting(say) | _starting(say)
    if growth:
        result["growth_ms"] = _growth(say)
    return result | {"task": TASK, "sizes": dataclasses.asdict(PAPER_SIZES), "machine": machine()}


def cost_of(phase_name: str, config: mbdpg.Config) -> Cost:
    """Time one update of a phase, as training takes it, and its matrix products alone."""
    learner = made_up_learner(config)
    phase = phase_of(learner.agent, phase_name)
    ms = update_ms(learner, phase)
    batch = jax.tree.map(lambda x: x[0], made_up_batches(phase, 1))
    state = jax.tree.map(lambda x: x[0], learner.state)
    update = jax.make_jaxpr(lambda s, b, k: phase.update(s, b, key=k))(state, batch, jax.random.key(0))
    products = matrix_products(update.jaxpr)
    gflop = sum(product.gflop * count for product, count in products.items())
    seconds = sum(product_seconds(product) * count for product, count in products.items())
    return Cost(ms, gflop, gflop / seconds)


def _acting(say: Say) -> dict[str, float]:
    """The NumPy policy's time per action, and environment steps per second with it."""
    policy = made_up_learner(PAPER_SIZES).policies()[0]
    env = RunConfig(TASK).make_env()
    observation = env.reset(seed=0)

    def act() -> None:
        for _ in range(500):
            policy(observation)

    def step() -> None:
        place = env.reset(seed=0)
        for _ in range(500):
            place = env.step(policy(place)).observation

    result = {"policy_us": 1e6 * median_seconds(act) / 500, "env_steps_per_s": 500 / median_seconds(step)}
    env.close()
    say("policy, one action", f"{result['policy_us']:.1f} us", "NumPy alone")
    say(f"{TASK} with it", f"{result['env_steps_per_s']:.0f} steps/s", "without learning")
    return result


def _starting(say: Say) -> dict[str, float]:
    """A fresh process up to its first updates, with nothing compiled before and then with everything; its memory."""
    result: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as cache:
        keep = {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(LEAST_SECONDS)}
        code = "import sys, mbdpg.cli.train; from mbdpg.experiments import benchmark; benchmark.start(*sys.argv[1:])"
        settings = json.dumps(dataclasses.asdict(DEFAULTS))
        for name in ("cold_start_s", "warm_start_s"):
            command = [sys.executable, "-c", code, settings, str(REPLAY_ROWS), str(time.time())]
            done = subprocess.run(command, env=os.environ | keep, stdout=subprocess.PIPE, text=True, check=True)
            measured = json.loads(done.stdout)
            result[name] = measured["seconds"]
            # Of both: the one that compiles takes more.
            result["peak_memory_mb"] = max(result.get("peak_memory_mb", 0.0), measured["memory_mb"])
    say("cold start", f"{result['cold_start_s']:.1f} s", "a fresh process up to one update of every kind")
    say("warm start", f"{result['warm_start_s']:.1f} s", "the same, compiled before")
    say(
        "peak memory",
        f"{result['peak_memory_mb']:.0f} MiB",
        f"of that process, with {REPLAY_ROWS:,} steps in its replay",
    )
    return result


def start(settings: str, rows: str, began: str) -> None:
    """Take one update of every kind in this fresh process, fill a replay, and print seconds and memory as JSON.

    Args:
        settings: of the agent, as JSON.
        rows: environment steps in the replay.
        began: seconds since the epoch at which the process was started.
    """
    learner = made_up_learner(mbdpg.Config(**json.loads(settings)))
    for phase in learner.agent.phases:
        if phase.updates_per_step:
            learner.update(phase, [made_up_batches(phase, 1)], 0)
    seconds = time.time() - float(began)
    kept = _replay(int(rows))
    print(json.dumps({"seconds": seconds, "memory_mb": _peak_memory_mb(), "rows": kept.size}))


def _peak_memory_mb() -> float:
    """Greatest resident memory of this process, in MiB."""
    try:
        # Linux's getrusage begins with the peak of the process that this one was forked from.
        with open("/proc/self/status", encoding="utf-8") as lines:
            return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
    except OSError:  # macOS, in bytes
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def _growth(say: Say) -> dict[str, dict[str, dict[int, float]]]:
    """Milliseconds of an update at other sizes and numbers of seeds, one thing changed at a time."""
    grown: dict[str, dict[str, dict[int, float]]] = {}
    for name, sizes in GROWTH.items():
        grown[name] = {"improving": {}, "fitting": {}}
        for size in sizes:
            changed: dict[str, Any] = {"seeds": {}, "batch_size": {"batch_size": size, "fit_batch_size": size}}.get(
                name, {name: size}
            )
            config = dataclasses.replace(PAPER_SIZES, **changed)
            learner = made_up_learner(config, size if name == "seeds" else 1)
            for kind, times in grown[name].items():
                times[size] = update_ms(learner, phase_of(learner.agent, kind))
                say(f"{kind}, {name} {size}", f"{times[size]:.1f} ms", "")
    return grown


def update_ms(learner: Learner, phase: Phase) -> float:
    """Milliseconds of one update, of several in one call as in training."""
    batches = [made_up_batches(phase, UPDATES)] * len(learner.policies())
    return 1e3 * median_seconds(lambda: learner.update(phase, batches, 0)) / UPDATES


def made_up_learner(config: mbdpg.Config, seeds: int = 1) -> Learner:
    """Fresh networks in the units of made-up experience."""
    learner = Learner(mbdpg.MBDPG(config, SPEC), range(seeds))
    learner.prepare([_replay(ROWS).statistics(0.0)] * seeds)
    return learner


def made_up_batches(phase: Phase, updates: int) -> Any:
    """What a phase learns from."""
    return _replay(ROWS).sample(updates, phase.sampling, np.random.default_rng(0))


@functools.cache
def _replay(rows: int) -> Replay:
    """Made-up steps, in episodes of 1,000."""
    replay, rng = Replay(SPEC.observation_size, SPEC.action_size), np.random.default_rng(0)
    for row in range(rows):
        observation, after = rng.normal(size=(2, SPEC.observation_size)).astype(np.float32)
        action = rng.uniform(-1, 1, SPEC.action_size).astype(np.float32)
        replay.add(observation, action, rng.normal(), after, False, row % 1000 == 999)
    return replay
