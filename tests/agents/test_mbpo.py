"""MBPO: what each of its phases moves, what it imagines, and what SAC is given of it."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.agents.mbpo import MBPO, Config, State
from mbdpg.dynamics.ensemble import predict
from mbdpg.interfaces import Batch, EnvSpec, Statistics, UserError, phase_of

O, A, BATCH = 3, 2, 8
ENV = EnvSpec("made-in-code", observation_size=O, action_size=A, episode_limit=None, reference_return=None)
SMALL: dict[str, Any] = {
    **{"width": 8, "batch_size": BATCH, "real_share": 0.25, "members": 3, "elites": 2, "dynamics_width": 8},
    **{"fit_batch_size": 4, "rollouts_per_step": 2, "imagine_every": 5, "retained_steps": 20},
}


def agent(env: EnvSpec = ENV, **settings: Any) -> MBPO:
    return MBPO(Config(**(SMALL | settings)), env)


def statistics(steps: float = 100.0) -> Statistics:
    numbers = ([0.1, -0.2, 0.3], [1.0, 2.0, 0.5], [0.2, 1.0, 0.25], 0.8, 5.0, 2.0, 0.0, steps)
    return Statistics(*(jnp.asarray(x, jnp.float32) for x in numbers))


@functools.cache
def state() -> State:
    """Networks away from their start, half of all steps end; the second member has the least error, the first most."""
    rng = np.random.default_rng(0)
    fresh = agent().init(key=jax.random.key(0))

    def networks(x: State) -> Any:
        return x.world.ensemble, x.soft.actor, x.soft.critics

    moved = jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.2, x.shape), jnp.float32), networks(fresh))
    moved = eqx.tree_at(networks, fresh, moved)
    biases = moved.world.ensemble.members.output.bias.at[:, -1].set(0.0)
    moved = eqx.tree_at(lambda x: x.world.ensemble.members.output.bias, moved, biases)
    return agent().prepare(eqx.tree_at(lambda x: x.world.errors, moved, jnp.asarray([3.0, 1.0, 2.0])), statistics())


def batch(size: int, seed: int = 1) -> Batch:
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=(size, 1, *shape)), jnp.float32)

    ends = jnp.asarray(rng.uniform(size=(size, 1)) < 0.3, jnp.float32)
    return Batch(draw(O), jnp.tanh(draw(A)), draw(), draw(O), ends, jnp.ones((size, 1)))


def take(name: str, before: State, one: MBPO | None = None, seed: int = 1) -> tuple[State, dict[str, Any]]:
    """One update of a phase."""
    one = one or agent()
    phase = phase_of(one, name)
    return jax.jit(phase.update)(before, batch(phase.sampling.batch_size, seed), key=jax.random.key(seed))


def test_phases_come_in_the_order_in_which_each_needs_the_one_before() -> None:
    assert [phase.name for phase in agent().phases] == ["fitting", "judging", "imagining", "improving"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("fitting", {"world"}),
        ("judging", {"world"}),
        ("imagining", {"imagined"}),
        ("improving", {"soft"}),
    ],
)
def test_a_phase_moves_its_own_part_alone(name: str, expected: set[str], differences: Callable[..., set[str]]) -> None:
    assert differences(state(), take(name, state())[0]) == expected


def test_fitting_and_judging_move_different_parts_of_the_world(differences: Callable[..., set[str]]) -> None:
    assert differences(state().world, take("fitting", state())[0].world) == {"ensemble", "optimizer"}
    assert differences(state().world, take("judging", state())[0].world) == {"errors"}


def test_fitting_moves_every_parameter_of_every_member() -> None:
    after, _ = take("fitting", state())
    for old, new in zip(jax.tree.leaves(state().world.ensemble), jax.tree.leaves(after.world.ensemble), strict=True):
        assert all((old[i] != new[i]).any() for i in range(3))


def test_learning_steps_are_never_the_ones_that_judge() -> None:
    parts = {phase.name: phase.sampling.part for phase in agent().phases}
    assert parts == {"fitting": "kept", "judging": "held-out", "imagining": "all", "improving": "all"}


def test_errors_are_a_running_average_and_begin_with_the_first() -> None:
    zero = eqx.tree_at(lambda x: x.world.errors, state(), jnp.full(3, jnp.nan))
    first = take("judging", zero)[0].world.errors
    assert (first > 0).all()
    second = take("judging", take("judging", zero)[0], seed=2)[0].world.errors
    np.testing.assert_allclose(second, 0.5 * (first + take("judging", zero, seed=2)[0].world.errors), rtol=1e-5)


def imagined(length: int, before: State | None = None, env: EnvSpec = ENV, **settings: Any) -> tuple[Any, jax.Array]:
    """The steps that rollouts of this length keep, and where they began."""
    one = agent(env, **settings)
    before = eqx.tree_at(lambda x: x.rollout_length, before or state(), jnp.int32(length))
    size = one.phases[2].sampling.batch_size
    before = eqx.tree_at(lambda x: x.imagined, before, one.init(key=jax.random.key(0)).imagined)
    after, _ = take("imagining", before, one)
    assert int(after.imagined.added) == size
    return jax.tree.map(lambda x: x[:size], after.imagined.rows), batch(size).observation[:, 0]


@functools.cache
def predictable() -> State:
    """Gaussians so narrow that a step tells which member took it, a policy that hardly varies, and no ends."""
    low = jnp.full((3, O + 1), -30.0)
    bias = state().world.ensemble.members.output.bias.at[:, -1].set(100.0)
    return eqx.tree_at(
        lambda x: (
            x.world.ensemble.members.max_log_variance,
            x.world.ensemble.members.min_log_variance,
            x.world.ensemble.members.output.bias,
            x.soft.actor.spread.bias,
        ),
        state(),
        (low, low, bias, jnp.full(A, -15.0)),
    )


def center(observation: jax.Array) -> jax.Array:
    """What the policy does there."""
    return state().soft.actor.center(state().soft.normalizer(observation))


def every_member(observation: jax.Array) -> jax.Array:
    """Where each member, following the policy, goes from there."""
    size = observation.shape[0]
    seen, action = (jnp.broadcast_to(x, (3, size, x.shape[1])) for x in (observation, center(observation)))
    return predict(predictable().world.ensemble, state().world.units, seen, action).next_observation


def nearest(paths: np.ndarray, found: jax.Array) -> int:
    """Which member's path was taken."""
    distances = np.abs(paths - np.asarray(found)).max(axis=1)
    assert distances.min() < 1e-2
    return int(np.argmin(distances))


def test_a_rollout_follows_the_actor_in_an_elite_drawn_anew_at_every_step() -> None:
    rows, start = imagined(2, predictable(), rollouts_per_step=40)
    first = np.all(np.asarray(rows.observation) == np.asarray(start), axis=1)
    assert 0.3 < first.mean() < 0.7  # of two steps one is kept, either as likely
    np.testing.assert_allclose(rows.action, center(rows.observation), atol=1e-3)
    begun, taken = np.asarray(every_member(start)), np.asarray(every_member(rows.observation))
    seconds = [nearest(taken[:, row], rows.next_observation[row]) for row in range(len(first))]
    firsts = [nearest(begun[:, row], rows.observation[row]) for row in np.flatnonzero(~first)]
    assert set(seconds) == set(firsts) == {1, 2}  # the elites


def test_actions_are_drawn() -> None:
    rows, start = imagined(1)
    assert (jnp.abs(rows.action) < 1).all() and np.abs(rows.action - center(start)).max() > 0.1


def test_where_a_rollout_ends_another_goes_on_from_another_start() -> None:
    ending = predictable().world.ensemble.members.output.bias.at[:, -1].set(-100.0)
    before = eqx.tree_at(lambda x: x.world.ensemble.members.output.bias, predictable(), ending)
    rows, start = imagined(3, before, rollouts_per_step=8)
    own, starts = np.asarray(rows.observation), np.asarray(start)
    depths = [next(t for t in range(3) if (own[row] == starts[row - t]).all()) for row in range(len(own))]
    assert set(depths) == {0, 1, 2} and (rows.terminated == 1).all()


def test_starts_about_to_end_do_not_fill_the_buffer_with_ends() -> None:
    """They began again where they had begun, and ended there at every step."""
    still = jax.tree.map(jnp.zeros_like, predictable().world.ensemble.members.output)
    before = eqx.tree_at(lambda x: x.world.ensemble.members.output, predictable(), still)
    ant = EnvSpec("Ant-v5", O, A, None, None)
    rows, start = imagined(8, before, ant, termination="known", rollouts_per_step=200)
    ending = float(np.mean((start[:, 0] < 0.2) | (start[:, 0] > 1.0)))
    # Nothing moves: at depth t those end that have ended at all depths before, each from a start of its own.
    expected = np.mean([ending ** (t + 1) for t in range(8)])
    assert abs(float(rows.terminated.mean()) - expected) < 0.05 < ending - expected


def test_long_rollouts_leave_shallow_steps_as_often_as_deep_ones() -> None:
    rows, start = imagined(8, predictable(), rollouts_per_step=200)
    first = np.all(np.asarray(rows.observation) == np.asarray(start), axis=1)
    assert 0.08 < first.mean() < 0.17


def test_an_end_is_paid_by_its_own_head() -> None:
    rows, _ = imagined(1, rollouts_per_step=8)
    size = rows.reward.shape[0]
    seen, action = (jnp.broadcast_to(x, (3, *x.shape)) for x in (rows.observation, rows.action))
    everywhere = predict(state().world.ensemble, state().world.units, seen, action)
    off = np.min(np.abs(np.asarray(everywhere.terminal_reward) - np.asarray(rows.reward)), axis=0)
    ended = np.flatnonzero(rows.terminated)
    assert 0 < len(ended) < size and set(np.unique(rows.terminated)) == {0.0, 1.0}
    assert (off[ended] < 1e-4).all() and (np.delete(off, ended) > 1e-4).all()


def test_a_known_rule_takes_the_place_of_the_learned_one() -> None:
    rows, _ = imagined(2, env=EnvSpec("Ant-v5", O, A, None, None), termination="known")
    height = rows.next_observation[..., 0]
    np.testing.assert_array_equal(rows.terminated == 0, (height >= 0.2) & (height <= 1.0))
    with pytest.raises(UserError, match="the rule of made-in-code is not"):
        agent(termination="known")


@pytest.mark.parametrize(("steps", "expected"), [(0, 1), (200, 1), (300, 3), (400, 5), (9000, 5)])
def test_rollouts_grow_between_two_steps(steps: int, expected: int) -> None:
    one = agent(lengthen_from=200, lengthen_until=400, final_rollout_length=5)
    assert int(one.prepare(state(), statistics(steps)).rollout_length) == expected


def test_the_ring_keeps_the_last_steps() -> None:
    one, current = agent(), state()
    for seed in range(5):
        current, _ = take("imagining", current, one, seed=seed)
    assert current.imagined.rows.reward.shape == (40,)  # 20 steps of 2 rollouts
    kept = set(np.asarray(current.imagined.rows.observation)[:, 0].tolist())
    assert kept == {float(x) for seed in range(1, 5) for x in batch(10, seed).observation[:, 0, 0]}


@pytest.mark.parametrize(("share", "real"), [(0.25, 2), (0.0, 0), (1.0, 8)])
def test_sac_is_given_a_share_of_real_transitions(share: float, real: int, monkeypatch: pytest.MonkeyPatch) -> None:
    one, given = agent(real_share=share), []
    filled, _ = take("imagining", state(), one)

    def spy(soft: Any, mixed: Batch, *, key: jax.Array) -> Any:
        given.append(mixed)
        return soft, {}

    monkeypatch.setattr(one._sac, "update", spy)
    true = batch(max(real, 1), seed=9)
    with jax.disable_jit():
        one.improve(filled, true, key=jax.random.key(0))
    assert given[0].reward.shape == (BATCH, 1) and (given[0].valid == 1).all()
    np.testing.assert_array_equal(given[0].reward[:real], true.reward[:real])
    known = set(np.asarray(filled.imagined.rows.reward).tolist())
    assert all(float(x) in known for x in given[0].reward[real:, 0])


def test_a_batch_that_is_not_finite_moves_no_member_and_is_counted(differences: Callable[..., set[str]]) -> None:
    phase = agent().phases[0]
    bad = batch(phase.sampling.batch_size)
    bad = bad._replace(reward=bad.reward.at[0].set(jnp.inf))
    after, metrics = jax.jit(phase.update)(state(), bad, key=jax.random.key(0))
    assert "ensemble" not in differences(state().world, after.world) and metrics["dynamics/skipped"] == 1


def test_instruments_are_sacs_and_the_ensembles() -> None:
    sampling = agent().diagnosis
    windows = jax.tree.map(lambda x: jnp.broadcast_to(x, (BATCH, sampling.length, *x.shape[2:])), batch(BATCH))
    metrics = jax.jit(agent().diagnose)(state(), windows, jnp.zeros(BATCH))
    assert {"critic/q_bias", "dynamics/rmse_k01", "dynamics/persistence_k20"} <= metrics.keys()
    assert all(np.isfinite(value) for value in metrics.values())
