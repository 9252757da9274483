"""One update of TD3: what it moves, and its targets against NumPy."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.agents.td3 import TD3, Config, State
from mbdpg.interfaces import Batch, EnvSpec, Statistics

O, A, BATCH, GAMMA = 3, 2, 6, 0.9
ENV = EnvSpec("made-in-code", observation_size=O, action_size=A, episode_limit=None, reference_return=None)
NOISELESS = (("target_noise", 0.0),)


def agent(settings: tuple = ()) -> TD3:
    return TD3(Config(width=8, batch_size=BATCH, discount=GAMMA, target_update_rate=0.25, **dict(settings)), ENV)


@functools.cache
def compiled(settings: tuple) -> Callable[..., Any]:
    return jax.jit(lambda state, batch, key: agent(settings).update(state, batch, key=key))


def update(state: State, batch: Batch, *, settings: tuple = (), seed: int = 0) -> tuple[State, dict[str, Any]]:
    return compiled(settings)(state, batch, jax.random.key(seed))


@functools.cache
def fresh() -> State:
    return jax.jit(lambda key: agent().init(key=key))(jax.random.key(0))


@functools.cache
def state() -> State:
    """Networks away from their start, targets away from what they follow, scales away from 1."""
    rng = np.random.default_rng(0)

    def networks(x: State):
        return x.actor, x.critics, x.target_actor, x.target_critics

    moved = jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.2, x.shape), jnp.float32), networks(fresh()))
    numbers = ([0.1, -0.2, 0.3], [1.0, 2.0, 0.5], [0.2, 1.0, 0.25], 0.8, 5.0, 2.0, 0.0, 100.0)
    statistics = Statistics(*(jnp.asarray(x, jnp.float32) for x in numbers))
    return agent().prepare(eqx.tree_at(networks, fresh(), moved), statistics)


def batch() -> Batch:
    rng = np.random.default_rng(1)

    def draw(*shape: int) -> np.ndarray:
        return rng.normal(size=(BATCH, 1, *shape)).astype(np.float32)

    terminated = np.zeros((BATCH, 1), np.float32)
    terminated[0] = 1
    return Batch(draw(O), np.tanh(draw(A)), draw(), draw(O), terminated, np.ones((BATCH, 1), np.float32))


CRITIC = {"critics", "critic_optimizer", "updates"}
ALL = CRITIC | {"actor", "actor_optimizer", "target_actor", "target_critics"}


def test_the_actor_and_the_targets_move_at_every_second_update(differences: Callable[..., set[str]]) -> None:
    states = [state()]
    for i in range(4):
        states.append(update(states[-1], batch(), seed=i)[0])
    moved = [differences(a, b) for a, b in itertools.pairwise(states)]
    assert moved == [CRITIC, ALL, CRITIC, ALL]
    before, after = states[1], states[2]
    for target, online in (("target_actor", "actor"), ("target_critics", "critics")):
        for old, new, followed in zip(
            *map(jax.tree.leaves, (getattr(before, target), getattr(after, target), getattr(after, online))),
            strict=True,
        ):
            np.testing.assert_allclose(new, 0.75 * old + 0.25 * followed, rtol=1e-5, atol=1e-6)


def test_a_fresh_state_has_targets_equal_to_what_they_follow() -> None:
    for online, target in (("actor", "target_actor"), ("critics", "target_critics")):
        pairs = zip(*(jax.tree.leaves(getattr(fresh(), name)) for name in (online, target)), strict=True)
        assert all(np.array_equal(x, y) for x, y in pairs)


def test_the_critic_loss_is_numpys() -> None:
    s, b = state(), jax.tree.map(lambda x: jnp.asarray(x[:, 0]), batch())
    after = s.normalizer(b.next_observation)
    next_values = np.asarray(s.target_critics(after, s.target_actor(after)))
    values = np.asarray(s.critics(s.normalizer(b.observation), b.action))
    loss = 0.0
    for i in range(BATCH):
        target = b.reward[i] / 2.0 + (0 if b.terminated[i] else GAMMA * min(next_values[0, i], next_values[1, i]))
        loss += sum((values[critic, i] - target) ** 2 for critic in range(2)) / BATCH
    metrics = update(s, batch(), settings=NOISELESS)[1]
    assert float(metrics["critic/loss"]) == pytest.approx(float(loss), rel=1e-4)
    assert float(metrics["critic/q_mean"]) == pytest.approx(2.0 * values.mean(), rel=1e-4)


def test_what_follows_an_end_changes_nothing_and_what_follows_a_time_limit_does(
    differences: Callable[..., set[str]],
) -> None:
    expected = update(state(), batch())[0]
    for row, matters in ((0, False), (1, True)):  # row 0 terminated; of a time limit the batch says nothing
        other = batch()
        other.next_observation[row] += 1
        assert ("critics" in differences(expected, update(state(), other)[0])) == matters


def test_the_noise_on_target_actions_is_bounded(differences: Callable[..., set[str]]) -> None:
    bounded = (("target_noise", 100.0), ("target_noise_clip", 0.0))
    quiet, _ = update(state(), batch(), settings=NOISELESS)
    assert not differences(quiet, update(state(), batch(), settings=bounded)[0])
    assert "critics" in differences(quiet, update(state(), batch())[0])


def test_the_actor_climbs_the_first_critic() -> None:
    before, _ = update(state(), batch())
    after, metrics = update(before, batch())
    observation = before.normalizer(jnp.asarray(batch().observation[:, 0]))
    old, new = (jnp.mean(after.critics(observation, s.actor(observation))[0]) for s in (before, after))
    assert new > old
    assert float(metrics["actor/objective"]) == pytest.approx(2 * float(old), rel=1e-4)  # reported at every 2nd


@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_a_batch_that_is_not_finite_moves_nothing_and_is_counted(
    poison: float, differences: Callable[..., set[str]]
) -> None:
    bad, current = batch(), state()
    bad.reward[1] = poison
    bad.observation[2] = np.nan
    for _ in range(2):
        current, metrics = update(current, bad)
    assert not {"actor", "critics"} & differences(state(), current)
    assert metrics["critic/skipped"] == 2 and metrics["actor/skipped"] == 1
    for _ in range(2):
        after, metrics = update(current, batch())
        current = after
    assert {"actor", "critics"} <= differences(state(), current)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(current))


def test_the_instruments_compare_values_with_returns() -> None:
    one = agent()
    assert one.diagnosis.burn_in == 0 and one.diagnosis.length == 1
    b = jax.tree.map(jnp.asarray, batch())
    realized = jnp.asarray([1.0, 2.0, *[jnp.nan] * (BATCH - 2)])
    metrics = one.diagnose(state(), b, realized)
    assert set(metrics) == {"critic/q_bias", "critic/realized_return"}
    values = state().critics(state().normalizer(b.observation[:2, 0]), b.action[:2, 0])
    assert float(metrics["critic/q_bias"]) == pytest.approx(2.0 * float(jnp.mean(jnp.min(values, 0))) - 1.5, rel=1e-4)


def test_the_behavior_policy_is_the_actor_with_constant_noise() -> None:
    actor, normalizer, std = agent().behavior(state())
    assert actor is state().actor and normalizer is state().normalizer
    assert (actor, normalizer) == agent().policy(state())
    assert float(std) == pytest.approx(0.1)
