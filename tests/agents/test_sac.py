"""One update of SAC: what it moves, and its losses against NumPy."""

import functools
from collections.abc import Callable
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
    *(
        jnp.asarray(x, jnp.float32)
        for x in ([0.1, -0.2, 0.3], [1.0, 2.0, 0.5], [0.2, 1.0, 0.25], 0.8, 5.0, 2.0, 0.0, 100.0)
    )
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


def test_every_update_moves_all_that_learns_and_the_targets_follow(differences: Callable[..., set[str]]) -> None:
    before = state()
    after, _ = update(before, batch())
    optimizers = {"actor_optimizer", "critic_optimizer", "temperature_optimizer"}
    assert differences(before, after) == LEARNED | optimizers | {"target_critics"}
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


def test_the_actor_steps_down_the_gradient_of_its_loss() -> None:
    s, b = state(), jax.tree.map(jnp.asarray, batch())
    after, _ = update(s, batch())
    observation = s.normalizer(b.observation[:, 0])
    noise = jax.random.normal(jax.random.split(jax.random.key(0))[1], (BATCH, A))

    def loss(actor: Any) -> jax.Array:
        features = actor.center.mlp.features(observation)
        log_std = actor.spread(features)
        unbounded = actor.center.mlp.output(features) + jnp.exp(log_std) * noise
        action = jnp.tanh(unbounded)
        density = jnp.sum(-0.5 * noise**2 - log_std - jnp.log(1 - action**2), axis=-1)
        return jnp.mean(jnp.exp(s.log_temperature) * density - jnp.min(after.critics(observation, action), axis=0))

    gradient = jax.grad(loss)(s.actor)
    for old, new, slope in zip(*map(jax.tree.leaves, (s.actor, after.actor, gradient)), strict=True):
        steep = np.abs(slope) > 1e-4  # of the first step of Adam only the sign is left
        np.testing.assert_allclose(np.asarray(new - old)[steep], -3e-4 * np.sign(slope)[steep], rtol=2e-2)


@pytest.mark.parametrize("more", [-0.1, 0.1])
def test_the_temperature_rises_just_where_entropy_is_missing(more: float) -> None:
    entropy = float(update(state(), batch())[1]["actor/entropy"])
    one = agent(entropy_per_action=entropy / A + more)
    after, _ = one.update(state(), jax.tree.map(jnp.asarray, batch()), key=jax.random.key(0))
    assert bool(after.log_temperature > state().log_temperature) == (more > 0)


def test_without_rewards_a_narrow_policy_widens() -> None:
    narrow = eqx.tree_at(lambda x: x.actor.spread.bias, agent().init(key=jax.random.key(0)), jnp.full(A, -3.0))
    nothing = jax.tree.map(jnp.asarray, batch()._replace(reward=np.zeros((BATCH, 1), np.float32)))
    one = agent(learning_rate=1e-2)

    def step(state: State, key: jax.Array) -> tuple[State, None]:
        return one.update(state, nothing, key=key)[0], None

    wide = jax.jit(lambda s, keys: jax.lax.scan(step, s, keys)[0])(narrow, jax.random.split(jax.random.key(1), 400))
    features = wide.actor.center.mlp.features(nothing.observation[:, 0])
    assert float(jnp.mean(jnp.exp(wide.actor.spread(features)))) > 0.4


def test_what_follows_an_end_changes_nothing_and_what_follows_a_time_limit_does(
    differences: Callable[..., set[str]],
) -> None:
    expected = update(state(), batch())[0]
    for row, matters in ((0, False), (1, True)):  # row 0 terminated; of a time limit the batch says nothing
        other = batch()
        other.next_observation[row] += 1
        assert ("critics" in differences(expected, update(state(), other)[0])) == matters


def test_a_batch_that_is_not_finite_moves_nothing_and_is_counted(differences: Callable[..., set[str]]) -> None:
    bad = batch()
    bad.reward[1], bad.observation[2] = np.inf, np.nan
    after, metrics = update(state(), bad)
    assert not LEARNED & differences(state(), after)
    assert metrics["critic/skipped"] == metrics["actor/skipped"] == 1
    assert differences(after, update(after, batch())[0]) >= LEARNED


def test_plain_networks_see_observations_and_rewards_as_they_are(differences: Callable[..., set[str]]) -> None:
    one = agent(plain=True, layers=2)
    fresh = one.init(key=jax.random.key(0))
    assert not differences(fresh, one.prepare(fresh, STATISTICS))
    assert len(fresh.actor.center.mlp.hidden) == 2 and not fresh.actor.center.mlp.norms
    far = jnp.asarray([20.0, -3000.0, 1.0])
    np.testing.assert_array_equal(fresh.normalizer(far), far)


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
