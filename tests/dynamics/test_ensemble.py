"""The ensemble of Gaussian networks: its loss against NumPy, its members apart from each other, and what it learns."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mbdpg.dynamics.ensemble import (
    Ensemble,
    Units,
    ensemble_loss,
    for_each,
    held_out_error,
    open_loop_error,
    predict,
)
from mbdpg.interfaces import Batch
from mbdpg.networks.normalizer import Normalizer

O, A, MEMBERS, BATCH = 2, 1, 3, 5
UNITS = Units(
    Normalizer(jnp.asarray([0.5, -1.0]), jnp.asarray([2.0, 0.5])),
    jnp.asarray([0.2, 0.4]),
    jnp.asarray(0.8, jnp.float32),
    jnp.asarray(5.0, jnp.float32),
)


def ensemble(seed: int = 0, width: int = 8) -> Ensemble:
    fresh = Ensemble(O, A, count=MEMBERS, widths=(width, width), key=jax.random.key(seed))
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.1, x.shape), jnp.float32), fresh)


def batch(*lead: int, seed: int = 1, ends: bool = True) -> Batch:
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=(*lead, *shape)), jnp.float32)

    terminated = jnp.asarray(rng.uniform(size=lead) < (0.4 if ends else 0), jnp.float32)
    return Batch(draw(O), jnp.tanh(draw(A)), draw(), draw(O), terminated, jnp.ones(lead))


def member(x: Any, i: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[i], x)


def forward(one: Ensemble, i: int, b: Batch) -> tuple[np.ndarray, ...]:
    """A member in NumPy: mean, log variance, terminal reward and logit, of a batch of its own."""
    network, mean, std = member(one.members, i), np.asarray([0.5, -1.0]), np.asarray([2.0, 0.5])
    x = np.concatenate([(np.asarray(b.observation) - mean) / std, b.action], axis=-1)
    for linear in network.hidden:
        x = x @ np.asarray(linear.weight) + np.asarray(linear.bias)
        x = x / (1 + np.exp(-x))
    x = x @ np.asarray(network.output.weight) + np.asarray(network.output.bias)
    high, low = np.asarray(network.max_log_variance), np.asarray(network.min_log_variance)
    log_variance = high - np.log1p(np.exp(high - x[:, O + 1 : 2 * O + 2]))
    return x[:, : O + 1], low + np.log1p(np.exp(log_variance - low)), x[:, -2], x[:, -1]


def test_the_loss_is_numpys() -> None:
    one, b, expected = ensemble(), jax.tree.map(np.asarray, batch(MEMBERS, BATCH)), 0.0
    assert 0 < b.terminated.sum() < b.terminated.size
    for i in range(MEMBERS):
        own = member(b, i)
        mean, log_variance, terminal_reward, logit = forward(one, i, own)
        for row in range(BATCH):
            delta = (own.next_observation[row] - own.observation[row]) / np.asarray([0.2, 0.4])
            for entry, target in enumerate([*delta, own.reward[row] / 0.8]):
                if entry < O or not own.terminated[row]:
                    square = (mean[row, entry] - target) ** 2 * np.exp(-log_variance[row, entry])
                    expected += (square + log_variance[row, entry]) / BATCH / (O + 1)
            survives = 1 / (1 + np.exp(-logit[row]))
            if own.terminated[row]:
                expected += ((terminal_reward[row] - own.reward[row] / 5.0) ** 2 - np.log(1 - survives)) / BATCH
            else:
                expected += -np.log(survives) / BATCH
        network = member(one.members, i)
        expected += 0.01 * float(np.sum(network.max_log_variance) - np.sum(network.min_log_variance))
        for linear in (*network.hidden, network.output):
            expected += 0.5 * 0.1 * float(np.sum(np.square(linear.weight)))
    loss, _ = ensemble_loss(one, UNITS, batch(MEMBERS, BATCH), weight_decay=0.1)
    assert float(loss) == pytest.approx(float(expected), rel=1e-4)


def test_a_member_learns_from_its_own_batch_alone() -> None:
    def gradients(b: Batch) -> Any:
        return jax.grad(lambda e: ensemble_loss(e, UNITS, b, weight_decay=0.0)[0])(ensemble())

    one, changed = batch(MEMBERS, BATCH), batch(MEMBERS, BATCH)
    changed = changed._replace(reward=changed.reward.at[1].add(1.0))
    before, after = gradients(one), gradients(changed)
    for i, same in enumerate((True, False, True)):
        pairs = zip(jax.tree.leaves(member(before, i)), jax.tree.leaves(member(after, i)), strict=True)
        assert all(np.array_equal(x, y) for x, y in pairs) == same


def test_members_begin_apart() -> None:
    fresh = Ensemble(O, A, count=MEMBERS, widths=(8,), key=jax.random.key(0))
    weights = fresh.members.hidden[0].weight
    assert not np.allclose(weights[0], weights[1])


def test_held_out_error_is_the_mean_squared_one_of_each_member() -> None:
    one, b = ensemble(), batch(BATCH, ends=False)
    errors = held_out_error(one, UNITS, b)
    for i in range(MEMBERS):
        delta = np.asarray(b.next_observation - b.observation) / np.asarray([0.2, 0.4])
        target = np.concatenate([delta, np.asarray(b.reward)[:, None] / 0.8], axis=-1)
        assert float(errors[i]) == pytest.approx(float(np.mean((forward(one, i, b)[0] - target) ** 2)), rel=1e-4)


def test_a_prediction_is_in_raw_units_and_drawn_with_the_member_s_own_spread() -> None:
    one, b = ensemble(), for_each(ensemble(), batch(BATCH))
    mean = predict(one, UNITS, b.observation, b.action)
    keys = jax.random.split(jax.random.key(0), 4000)
    draws = jax.jit(jax.vmap(lambda key: predict(one, UNITS, b.observation, b.action, key=key)))(keys)
    for i in range(MEMBERS):
        center, log_variance, terminal_reward, logit = forward(one, i, member(b, i))
        after = np.asarray(b.observation[i]) + center[:, :O] * np.asarray([0.2, 0.4])
        np.testing.assert_allclose(mean.next_observation[i], after, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(mean.reward[i], 0.8 * center[:, O], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(mean.terminal_reward[i], 5.0 * terminal_reward, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(mean.continues[i], 1 / (1 + np.exp(-logit)), rtol=1e-4)
        std = np.exp(0.5 * log_variance) * np.asarray([0.2, 0.4, 0.8])
        np.testing.assert_allclose(np.std(draws.next_observation[:, i], axis=0), std[:, :O], rtol=0.1)
        np.testing.assert_allclose(np.std(draws.reward[:, i], axis=0), std[:, O], rtol=0.1)
        np.testing.assert_allclose(np.mean(draws.reward[:, i], axis=0), mean.reward[i], atol=0.1)


def test_chosen_members_are_those() -> None:
    one, b = ensemble(), for_each(ensemble(), batch(BATCH))
    order = jnp.asarray([2, 0])
    some = predict(one.chosen(order), UNITS, b.observation[:2], b.action[:2])
    np.testing.assert_allclose(some.reward, predict(one, UNITS, b.observation, b.action).reward[order], rtol=1e-5)


def test_open_loop_errors_are_a_python_loops() -> None:
    one, windows = ensemble(), batch(4, 3)
    windows = windows._replace(valid=windows.valid.at[0, 2].set(0.0))
    errors = open_loop_error(one, UNITS, windows)
    observation = for_each(one, windows).observation[:, :, 0]
    for depth in range(1, 4):
        action = for_each(one, windows).action[:, :, depth - 1]
        observation = predict(one, UNITS, observation, action).next_observation
        truth = np.asarray(windows.next_observation[:, depth - 1])
        off = (np.mean(np.asarray(observation), axis=0) - truth) / np.asarray([2.0, 0.5])
        stay = (np.asarray(windows.observation[:, 0]) - truth) / np.asarray([2.0, 0.5])
        rows = slice(1, None) if depth == 3 else slice(None)
        for found, error in zip(errors[depth - 1], (off, stay), strict=True):
            expected = np.sqrt(np.mean(np.square(np.asarray(error)[rows])))
            assert float(found) == pytest.approx(float(expected), rel=1e-4)


def test_it_learns_a_noisy_world_its_noise_and_its_end() -> None:
    rng, rows = np.random.default_rng(0), 2048
    observation, action = rng.normal(size=(rows, O)), rng.uniform(-1, 1, (rows, A))
    after = observation + 0.3 * action + rng.normal(size=(rows, O)) * [0.05, 0.2]
    ends = after[:, 0] > 1.0
    reward = np.where(ends, -10.0, 2.0 * observation[:, 1])
    world = Batch(*(jnp.asarray(x, jnp.float32) for x in (observation, action, reward, after, ends, np.ones(rows))))
    units = Units(
        Normalizer(jnp.zeros(O), jnp.ones(O)), jnp.full(O, 0.2), *(jnp.asarray(x, jnp.float32) for x in (2.0, 10.0))
    )
    optimizer = optax.adam(3e-3)

    def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
        one, state = carry
        drawn = jax.random.randint(key, (MEMBERS, 128), 0, rows)
        own = jax.tree.map(lambda x: x[drawn], world)
        gradient = jax.grad(lambda e: ensemble_loss(e, units, own, weight_decay=1e-5)[0])(one)
        updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(one, updates), state), None

    begin = ensemble(width=32)
    keys = jax.random.split(jax.random.key(1), 1500)
    learned = jax.jit(lambda e: jax.lax.scan(step, (e, optimizer.init(e)), keys)[0][0])(begin)
    where = jnp.asarray([[0.0, 0.5], [0.0, -0.5], [1.5, 0.0]])
    imagined = predict(learned, units, jnp.broadcast_to(where, (MEMBERS, 3, O)), jnp.full((MEMBERS, 3, A), 0.5))
    np.testing.assert_allclose(imagined.next_observation, np.broadcast_to(where + 0.15, (MEMBERS, 3, O)), atol=0.06)
    np.testing.assert_allclose(imagined.reward[:, :2], [[1.0, -1.0]] * MEMBERS, atol=0.2)
    np.testing.assert_allclose(imagined.terminal_reward[:, 2], -10.0, atol=1.0)
    assert (imagined.continues[:, :2] > 0.95).all() and (imagined.continues[:, 2] < 0.05).all()
    spread = learned(jnp.broadcast_to(where, (MEMBERS, 3, O)), jnp.full((MEMBERS, 3, A), 0.5)).log_variance
    np.testing.assert_allclose(0.2 * np.exp(0.5 * spread[:, :2, :O]), [[[0.05, 0.2]] * 2] * MEMBERS, rtol=0.3)
