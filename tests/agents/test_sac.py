"""One update of SAC: what it moves, and its losses against NumPy."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.agents.sac import SAC, Config, State
from mbdpg.interfaces import Batch, EnvSpec, Statistics

O, A, BATCH, GAMMA = 3, 2, 6, 0.9
ENV = EnvSpec("made-in-code", observation_size=O, action_size=A, episode_limit=None, reference_return=None)
LEARNED = {"actor", "critics", "log_temperature"}
STATISTICS = Statistics(
    *(jnp.asarray(x, jnp.float32) for x in ([0.1, -0.2, 0.3], [1.0, 2.0, 0.5], [0.2, 1.0, 0.25], 0.8, 5.0, 2.0, 0.0))
)


def agent(**settings: Any) -> SAC:
    return SAC(Config(width=8, batch_size=BATCH, discount=GAMMA, target_update_rate=0.25, **settings), ENV)


@functools.cache
def compiled() -> Any:
    return jax.jit(lambda state, batch, key: agent().update(state, batch, key=key))


def update(state: State, batch: Batch) -> tuple[State, dict[str, Any]]:
    return compiled()(state, batch, jax.random.key(0))


@functools.cache
def state() -> State:
    """Networks away from their start, targets away from what they follow, scales and temperature away from 1."""
    rng = np.random.default_rng(0)
    fresh = agent().init(key=jax.random.key(0))

    def learned(x: State) -> Any:
        return x.actor, x.critics, x.target_critics, x.log_temperature

    moved = jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.2, x.shape), jnp.float32), learned(fresh))
    return agent().prepare(eqx.tree_at(learned, fresh, moved), STATISTICS)


def batch() -> Batch:
    rng = np.random.default_rng(1)

    def draw(*shape: int) -> np.ndarray:
        return rng.normal(size=(BATCH, 1, *shape)).astype(np.float32)

    terminated = np.zeros((BATCH, 1), np.float32)
    terminated[0] = 1
    return Batch(draw(O), np.tanh(draw(A)), draw(), draw(O), terminated, np.ones((BATCH, 1), np.float32))


def moved(before: Any, after: Any) -> set[str]:
    """Fields in which two states differ in any bit."""

    def same(a: jax.Array, b: jax.Array) -> bool:
        return np.asarray(a).tobytes() == np.asarray(b).tobytes()

    return {
        name
        for name in vars(before)
        if not all(jax.tree.leaves(jax.tree.map(same, getattr(before, name), getattr(after, name))))
    }


def test_every_update_moves_all_that_learns_and_the_targets_follow() -> None:
    before = state()
    after, _ = update(before, batch())
    optimizers = {"actor_optimizer", "critic_optimizer", "temperature_optimizer"}
    assert moved(before, after) == LEARNED | optimizers | {"target_critics", "updates"}
    for old, new, followed in zip(
        *map(jax.tree.leaves, (before.target_critics, after.target_critics, after.critics)), strict=True
    ):
        np.testing.assert_allclose(new, 0.75 * old + 0.25 * followed, rtol=1e-5, atol=1e-6)


def test_the_losses_are_numpys() -> None:
    s, b = state(), jax.tree.map(lambda x: jnp.asarray(x[:, 0]), batch())
    target_key, actor_key = jax.random.split(jax.random.key(0))
    after, temperature = s.normalizer(b.next_observation), np.exp(s.log_temperature)
    action, density = s.actor.sample(after, key=target_key)
    next_values = np.asarray(s.target_critics(after, action))
    values = np.asarray(s.critics(s.normalizer(b.observation), b.action))
    loss = 0.0
    for i in range(BATCH):
        soft = min(next_values[0, i], next_values[1, i]) - temperature * density[i]
        target = b.reward[i] / 2.0 + (0 if b.terminated[i] else GAMMA * soft)
        loss += sum((values[critic, i] - target) ** 2 for critic in range(2)) / BATCH
    learned, metrics = update(s, batch())
    assert float(metrics["critic/loss"]) == pytest.approx(float(loss), rel=1e-4)
    assert float(metrics["critic/q_mean"]) == pytest.approx(2.0 * values.mean(), rel=1e-4)
    action, density = s.actor.sample(s.normalizer(b.observation), key=actor_key)
    values = np.asarray(learned.critics(s.normalizer(b.observation), action))
    objective = np.mean(values.min(axis=0) - temperature * np.asarray(density))
    assert float(metrics["actor/objective"]) == pytest.approx(float(objective), rel=1e-4)
    assert float(metrics["actor/entropy"]) == pytest.approx(-float(np.mean(density)), rel=1e-4)


@pytest.mark.parametrize(("wanted", "rises"), [(-20.0, False), (20.0, True)])
def test_the_temperature_rises_where_entropy_is_missing(wanted: float, rises: bool) -> None:
    one = agent(entropy_per_action=wanted)
    after, _ = one.update(state(), jax.tree.map(jnp.asarray, batch()), key=jax.random.key(0))
    assert (after.log_temperature > state().log_temperature) == rises


def test_what_follows_an_end_changes_nothing_and_what_follows_a_time_limit_does() -> None:
    expected = update(state(), batch())[0]
    for row, matters in ((0, False), (1, True)):  # row 0 terminated; of a time limit the batch says nothing
        other = batch()
        other.next_observation[row] += 1
        assert ("critics" in moved(expected, update(state(), other)[0])) == matters


def test_a_batch_that_is_not_finite_moves_nothing_and_is_counted() -> None:
    bad = batch()
    bad.reward[1], bad.observation[2] = np.inf, np.nan
    after, metrics = update(state(), bad)
    assert not LEARNED & moved(state(), after)
    assert metrics["critic/skipped"] == metrics["actor/skipped"] == 1
    assert moved(after, update(after, batch())[0]) >= LEARNED


def test_plain_networks_see_observations_and_rewards_as_they_are() -> None:
    one = agent(plain=True, layers=2)
    fresh = one.init(key=jax.random.key(0))
    assert not moved(fresh, one.prepare(fresh, STATISTICS))
    assert len(fresh.actor.center.mlp.hidden) == 2 and not fresh.actor.center.mlp.norms


def test_the_center_is_evaluated_and_the_gaussian_collects() -> None:
    center, normalizer = agent().policy(state())
    assert center is state().actor.center and normalizer is state().normalizer
    actor, normalizer, std = agent().behavior(state())
    assert actor is state().actor and normalizer is state().normalizer and float(std) == 1


def test_the_instruments_compare_values_with_returns() -> None:
    one, b = agent(), jax.tree.map(jnp.asarray, batch())
    assert one.diagnosis.burn_in == 0 and one.diagnosis.length == 1
    metrics = one.diagnose(state(), b, jnp.asarray([1.0, 2.0, *[jnp.nan] * (BATCH - 2)]))
    values = state().critics(state().normalizer(b.observation[:2, 0]), b.action[:2, 0])
    assert float(metrics["critic/q_bias"]) == pytest.approx(2.0 * float(jnp.mean(jnp.min(values, 0))) - 1.5, rel=1e-4)
