"""PETS: it fits its world, and plans with the best of it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from mbdpg.agents.pets import PETS, Config
from mbdpg.dynamics.planning import PlanningPolicy, planner_arrays, planner_of
from mbdpg.interfaces import Batch, EnvSpec
from mbdpg.training.learner import Learner
from mbdpg.training.replay import Replay

ENV = EnvSpec("Ant-v5", observation_size=2, action_size=1, episode_limit=None, reference_return=None)


def agent(**settings: float | str) -> PETS:
    small = {"members": 3, "dynamics_width": 8, "fit_batch_size": 4, "population": 8, "plan_elites": 2}
    return PETS(Config(**(small | {"horizon": 3} | settings)), ENV)


def test_it_plans_with_its_settings_and_all_it_has_learned() -> None:
    one = agent(discount=0.9, smoothing=0.2, iterations=2, particles=3, termination="known")
    world = one.init(key=jax.random.key(0))
    planner, normalizer = one.policy(world)
    assert (planner.horizon, planner.particles, planner.population, planner.plan_elites) == (3, 3, 8, 2)
    assert (planner.iterations, planner.smoothing, planner.discount, planner.rule) == (2, 0.2, 0.9, "Ant")
    assert normalizer is world.units.normalizer
    assert planner.ensemble is world.ensemble
    again, _, std = agent(exploration_std=0.3).behavior(world)
    assert float(std) == np.float32(0.3) and again.rule is None


def test_a_policy_of_whole_numbers_for_shares_is_read_again() -> None:
    """`PETSConfig(discount=1)` trained, and its own policy was refused as impossible."""
    one = agent(discount=1, smoothing=0)
    planner, _ = one.policy(one.init(key=jax.random.key(0)))
    back = planner_of(planner_arrays(planner))
    assert (back.discount, back.smoothing) == (1.0, 0.0)


def test_instruments_are_of_the_model_alone() -> None:
    one, shape = agent(), (4, 20)
    windows = Batch(
        *(jnp.ones((*shape, size)) for size in (2, 1)),
        jnp.ones(shape),
        jnp.ones((*shape, 2)),
        jnp.zeros(shape),
        jnp.ones(shape),
    )
    metrics = one.diagnose(one.init(key=jax.random.key(0)), windows, jnp.zeros(4))
    assert set(metrics) == {f"dynamics/{x}_k{k:02d}" for x in ("rmse", "persistence") for k in (1, 5, 10, 20)}


def test_a_fit_moves_every_parameter_and_nothing_but_the_ensemble(differences: Callable[..., set[str]]) -> None:
    (phase,), before = agent().phases, agent().init(key=jax.random.key(0))
    rng, size = np.random.default_rng(0), phase.sampling.batch_size
    shapes = {"observation": (2,), "action": (1,), "reward": (), "next_observation": (2,)}
    drawn = {name: jnp.asarray(rng.normal(size=(size, 1, *shape)), jnp.float32) for name, shape in shapes.items()}
    ends = jnp.asarray(np.arange(size) % 3 == 0, jnp.float32)[:, None]  # the terminal reward's head learns from them
    batch = Batch(**drawn, terminated=ends, valid=jnp.ones((size, 1)))
    fit = jax.jit(phase.update)
    after, _ = fit(before, batch, key=jax.random.key(1))
    assert differences(before, after) == {"ensemble", "optimizer"}
    for old, new in zip(jax.tree.leaves(before.ensemble), jax.tree.leaves(after.ensemble), strict=True):
        assert all((a != b).any() for a, b in zip(old, new, strict=True))  # of each member
    bad, metrics = fit(before, batch._replace(reward=batch.reward.at[0].set(jnp.nan)), key=jax.random.key(1))
    assert differences(before, bad) == {"optimizer"} and metrics["dynamics/skipped"] == 1


def test_it_brings_a_point_to_where_the_reward_is() -> None:
    """One step of a point that an action moves by a half, paid for its nearness to 0."""
    env = EnvSpec("point", observation_size=1, action_size=1, episode_limit=None, reference_return=None)
    config = Config(members=2, dynamics_width=16, fit_batch_size=32, horizon=2, population=60, plan_elites=6)
    rng, replay, learner = np.random.default_rng(0), Replay(1, 1), Learner(PETS(config, env), [0])
    for step in range(600):
        place, action = rng.uniform(-1, 1, 1), rng.uniform(-1, 1, 1)
        after = place + 0.5 * action
        replay.add(*np.float32([place, action]), float(-abs(after[0])), np.float32(after), False, step % 5 == 4)
    learner.prepare([replay.statistics(0.0)])
    (fitting,) = learner.agent.phases
    assert fitting.sampling.part == "all"
    learner.update(fitting, [replay.sample(600, fitting.sampling, rng)], 0)
    (policy,) = learner.policies()
    assert isinstance(policy, PlanningPolicy)
    for place in (-0.4, 0.0, 0.3):
        policy.reset()
        assert abs(place + 0.5 * float(policy(np.float32([place]))[0])) < 0.12
