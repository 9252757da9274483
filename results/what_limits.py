"""What a run of MBDPG is limited by, asked of its newest checkpoint alone; nothing is written, no new step is taken.

    python results/what_limits.py policy RUN [--updates 4000] [--fresh] [--fits-per-update 1] [--planning deterministic]
    python results/what_limits.py objective RUN
    python results/what_limits.py model RUN --learned 36000 [--updates 3000] [--fit-length 5 --burn-in 1]

`policy` goes on learning from the replay as it is. If the real return rises, updates were missing; if what the policy
earns in the model rises and the real return does not, it exploits the model's errors; if neither does, it is at an
optimum of this model, and needs another model or new steps. With `--fresh` actor and critics begin anew, on the
dynamics and steps that are there: if they come to more than the run's own, those had settled on what they saw first.
`objective` takes apart what the actor climbs: the value of its first action, returns over so many imagined steps and a
value after them, by the lesser of both critics and by their mean, and the penalty of saturated actions. What real
episodes pay a small step back and on along each gradient tells which of them mislead: where learning has come to rest
they add up to nothing, and those along which real returns fall hold the others back. A batch's gradient that is much
larger than the mean of many is noise of the batch; one that is not is what the critics believe at the moment.
`model` trains the dynamics afresh on the first steps and tests them on those that came later, which is what they are
needed for: episodes of policies that they have not seen. Other settings of the agent's than the run's are `mbdpg
train`'s flags.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any, cast, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from mbdpg.agents import objectives
from mbdpg.agents.mbdpg import MBDPG, Config
from mbdpg.dynamics.accuracy import DEPTHS
from mbdpg.dynamics.fitting import open_loop_error
from mbdpg.dynamics.imagination import imagine
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.experiments.config import RunConfig
from mbdpg.interfaces import Environment, Sampling, phase_of, require
from mbdpg.networks.policy import NumpyPolicy, policy_arrays
from mbdpg.storage.checkpoint import load_checkpoint
from mbdpg.storage.run_folder import RunFolder
from mbdpg.training.evaluation import evaluate
from mbdpg.training.learner import Learner
from mbdpg.training.replay import Replay

PER_CALL = 50
SAY_EVERY = 1000
RECENT = 6000
"""Newest steps that imagination starts from."""
BATCHES = 64
"""From which the mean gradients of the actor's objective are taken."""
STEP = 1e-4
"""Along such a gradient: root mean square change of a parameter."""
DREAM = 200
"""Imagined steps; rewards of the second half are compared with what an episode pays per step."""


def actor_and_critics(state: Any) -> tuple[Any, ...]:
    """What learns in an update of actor and critics."""
    actors = state.actor, state.average_actor, state.target_actor, state.actor_optimizer
    return *actors, state.critics, state.target_critics, state.critic_optimizer


def policy(options: argparse.Namespace) -> None:
    """Go on learning, the replay as it is."""
    agent, env, replay, arrays = load(options)
    learner, rng = Learner(agent, [options.seed]), np.random.default_rng(options.seed)
    drawn_anew = learner.state
    learner.restore([arrays])
    if options.fresh:
        learner.state = eqx.tree_at(actor_and_critics, learner.state, actor_and_critics(drawn_anew))
    phases = {phase.name: phase for phase in agent.phases}
    improving, grounding, fitting = phases["improving"], phases["grounding"], phases["fitting"]
    recent = rng.integers(max(replay.size - RECENT, 0), replay.size, 256)
    starts = replay.windows(recent, improving.sampling)
    drawn = agent.config.planning == "stochastic"

    @jax.jit
    def dream(states: Any, key: Any) -> Any:
        state = jax.tree.map(lambda leaf: leaf[0], states)
        start = agent._start(state, state.window(starts), key=key)
        model, actor, key = state.average_dynamics, state.average_actor, key if drawn else None
        imagined = imagine(model, state.scales, actor, start.observation, start.memory, horizon=DREAM, key=key)
        return jnp.mean(imagined.rewards[DREAM // 2 :]) * state.return_scale

    for done in range(0, options.updates + 1, PER_CALL):
        if done % SAY_EVERY == 0:
            played = evaluate(env, learner.policies()[0], range(1000, 1005))
            paid = sum(played.returns) / sum(played.lengths)
            dreamed = float(dream(learner.state, jax.random.key(done)))
            says = f"return {np.mean(played.returns):7.0f}  per step {paid:6.3f}, in the model {dreamed:6.3f}"
            print(f"{done:6,} updates  {says}", flush=True)
        if done + PER_CALL > options.updates:
            break
        learner.update(improving, [replay.sample(PER_CALL, improving.sampling, rng)], done)
        if grounding.updates_per_step:
            learner.update(grounding, [replay.sample(PER_CALL, grounding.sampling, rng)], done)
        fits = round(PER_CALL * options.fits_per_update)
        if fits > 0:
            learner.update(fitting, [replay.sample(fits, fitting.sampling, rng)], done)
    env.close()


def objective(options: argparse.Namespace) -> None:
    """Follow each part of the actor's objective a little in the real environment."""
    agent, env, replay, arrays = load(options)
    config, learner, rng = agent.config, Learner(agent, [options.seed]), np.random.default_rng(options.seed)
    learner.restore([arrays])
    state = jax.tree.map(lambda leaf: leaf[0], learner.state)
    sampling = phase_of(agent, "improving").sampling
    batches = [jax.tree.map(lambda x: x[0], replay.sample(1, sampling, rng)) for _ in range(BATCHES)]
    keys = list(jax.random.split(jax.random.key(options.seed), BATCHES))

    def parts(actor: Any, batch: Any, key: Any) -> dict[str, Any]:
        """Means over a batch."""
        start = agent._start(state, state.window(batch), key=key)
        drawn = key if config.planning == "stochastic" else None
        imagined = imagine(state.average_dynamics, state.scales, actor, *start[:2], horizon=config.horizon, key=drawn)
        values, survival = state.critics(imagined.observations, imagined.actions), imagined.survival()

        def climbed(kind: objectives.ActorValue, first: int, last: int) -> Any:
            """Mean return over `first` to `last` imagined steps, and a value after them."""
            returns = objectives.policy_objective(
                imagined.rewards[:last],
                objectives.climbed_value(values, kind)[first : last + 1],
                survival[: last + 1],
                discount=config.discount,
                beta=jnp.ones(()),
                reward_weights="remaining",
            )
            return jnp.mean(returns * start.weight)

        found = {"less saturation": -jnp.mean(jnp.square(actor.mlp(start.observation)))}
        for kind in get_args(objectives.ActorValue):
            found |= {f"{k} steps, {kind}": climbed(kind, k, k) for k in range(config.horizon + 1)}
            found[f"all of them, {kind}"] = climbed(kind, 0, config.horizon)
        return found

    slopes = jax.jit(jax.jacrev(parts))
    actor, drawn = state.average_actor, zip(batches, keys, strict=True)
    summed = [slopes(actor, batch, key) for batch, key in drawn]
    gradients = jax.tree.map(lambda *leaves: sum(leaves), *summed)

    def played(direction: Any, step: float) -> float:
        moved = jax.tree.map(lambda leaf, d: leaf + step * d, actor, direction)
        policy = NumpyPolicy(policy_arrays(moved, state.normalizer))
        return float(np.mean(evaluate(env, policy, range(1000, 1005)).returns))

    noisy, entries = summed[0], sum(leaf.size for leaf in jax.tree.leaves(actor))
    print(f"return {played(actor, 0.0):.0f}; a root mean square step of {STEP:g} back and on along a part's gradient,")
    print(f"and that gradient's norm from one batch and from {BATCHES}")
    for name, direction in gradients.items():
        step = STEP * entries**0.5 / float(optax.tree.norm(direction))
        norms = f"{optax.tree.norm(noisy[name]):8.3f} {optax.tree.norm(direction) / BATCHES:8.3f}"
        print(f"{name:22} {played(direction, -step):7.0f} {played(direction, step):7.0f} {norms}", flush=True)
    env.close()


def model(options: argparse.Namespace) -> None:
    """Train dynamics on the first steps, test them on the later ones."""
    agent, env, replay, _ = load(options)
    env.close()
    rng, burn_in = np.random.default_rng(0), agent.config.burn_in
    rows, start = np.arange(replay.size), replay.columns()["start"]
    starts, episode = np.unique(start, return_inverse=True)
    ends = np.append(starts[1:], replay.size)[episode]
    later = np.flatnonzero((rows >= options.learned) & (rows + max(DEPTHS) <= ends))
    most = f"--learned is {options.learned}, expected fewer than the run's {replay.size:,} steps"
    require(options.learned > 0 and later.size > 0, f"{most}, by one of {max(DEPTHS)} steps that follow in an episode")
    tested = replay.windows(rng.choice(later, 1024), Sampling(1024, burn_in, max(DEPTHS)))
    learner = Learner(agent, [0])
    learner.prepare([replay.statistics(0.0)])
    fitting = phase_of(agent, "fitting")

    @jax.jit
    def measure(states: Any) -> Any:
        state = jax.tree.map(lambda leaf: leaf[0], states)
        window = state.window(tested)
        return open_loop_error(state.average_dynamics, state.scales, window, burn_in=burn_in)

    began = time.perf_counter()
    for done in range(PER_CALL, options.updates + 1, PER_CALL):
        drawn = rng.integers(0, options.learned, (PER_CALL, fitting.sampling.batch_size))
        learner.update(fitting, [replay.windows(drawn, fitting.sampling)], done)
        if done % SAY_EVERY == 0:
            found = np.asarray(measure(learner.state))[[depth - 1 for depth in DEPTHS], 0]
            errors = " / ".join(f"{error:.3f}" for error in found)
            print(f"{done:6,} updates  error after {DEPTHS} steps {errors}  {time.perf_counter() - began:.0f} s")


def load(options: argparse.Namespace) -> tuple[MBDPG, Environment, Replay, dict[str, np.ndarray]]:
    """The run's agent with other settings, its environment, its replay and the arrays of its newest checkpoint."""
    config, checkpoint = RunConfig.of(RunFolder.open(options.run)), load_checkpoint(options.run)
    require(isinstance(config.agent, Config), f"{options.run} is of {config.algorithm}, expected mbdpg")
    settings = tyro.cli(Config, args=options.settings, default=cast(Config, config.agent))
    require(settings.horizon > 0, f"{options.run} has no model, expected one, or for `model` a --horizon")
    env = config.make_env()
    agent = MBDPG(settings, env.spec)
    return agent, env, Replay.from_columns(checkpoint.replay), checkpoint.arrays


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("question", choices=("policy", "objective", "model"))
    parser.add_argument("run", type=Path)
    parser.add_argument("--updates", type=int, default=3000)
    parser.add_argument("--fresh", action="store_true", help="actor and critics begin anew")
    parser.add_argument("--seed", type=int, default=0, help="of batches, and of what begins anew")
    parser.add_argument("--fits-per-update", type=float, default=0.0)
    parser.add_argument("--learned", type=int, default=0, help="environment steps that the dynamics learn from")
    keep_compilations()
    asked, settings = parser.parse_known_args()
    asked.settings = settings
    {"policy": policy, "objective": objective, "model": model}[asked.question](asked)
