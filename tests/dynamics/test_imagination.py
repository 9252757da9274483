"""Imagined trajectories against a Python loop, where their gradients go, and the buffer of imagined states."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.dynamics.imagination import UNROLLED, Ring, Start, Trajectory, imagine
from mbdpg.dynamics.mixture import Memory, MixtureDynamics, Scales, next_observation
from mbdpg.networks.policy import Policy

O, A, MEMORY, BATCH = 3, 2, 4, 3
SCALES = Scales(jnp.asarray([0.5, 1.0, 2.0]), jnp.float32(0.7), jnp.float32(3.0))


def shaken(module, seed: int):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.3, x.shape), jnp.float32), module)


DYNAMICS = shaken(MixtureDynamics(O, A, gaussians=2, memory=MEMORY, widths=(8,), key=jax.random.key(0)), 0)
POLICY = shaken(Policy(O, A, (8,), key=jax.random.key(1)), 1)


def start(seed: int = 0, batch: int = BATCH) -> tuple[jax.Array, Memory]:
    rng = np.random.default_rng(seed)
    memory = Memory(*(jnp.asarray(rng.normal(size=(batch, MEMORY)), jnp.float32) for _ in range(2)))
    return jnp.asarray(rng.normal(size=(batch, O)), jnp.float32), memory


@pytest.mark.parametrize("horizon", [1, UNROLLED + 2])
def test_imagination_is_a_python_loop(horizon: int) -> None:
    observation, memory = start()
    imagined = imagine(DYNAMICS, SCALES, POLICY, observation, memory, horizon=horizon)
    for t in range(horizon):
        action = POLICY(observation)
        np.testing.assert_allclose(imagined.observations[t], observation, atol=1e-4)
        np.testing.assert_allclose(imagined.actions[t], action, atol=1e-4)
        memory = DYNAMICS.remember(memory, observation, action)
        p = DYNAMICS.predict(memory, observation, action)
        after = next_observation(observation, p.mean(), SCALES)
        outcome = DYNAMICS.outcome(memory, observation, action, p.mean())
        lives = 1 / (1 + np.exp(-np.asarray(outcome.continue_logit)))
        reward = lives * np.asarray(outcome.reward) * 0.7 + (1 - lives) * np.asarray(outcome.terminal_reward) * 3.0
        np.testing.assert_allclose(imagined.continues[t], lives, atol=1e-4)
        np.testing.assert_allclose(imagined.rewards[t], reward, atol=1e-4)
        observation = after
    np.testing.assert_allclose(imagined.observations[horizon], observation, atol=1e-4)
    np.testing.assert_allclose(imagined.actions[horizon], POLICY(observation), atol=1e-4)
    np.testing.assert_allclose(imagined.memory.cell, memory.cell, atol=1e-4)
    assert len(imagined.rewards) == horizon and len(imagined.observations) == horizon + 1


def test_survival_is_the_product_of_the_steps_before() -> None:
    continues = jnp.asarray([[0.5, 1.0], [0.0, 1.0], [1.0, 0.25]])
    still = jnp.zeros((4, 2, 1))
    survival = Trajectory(still, still, continues, continues, start(batch=2)[1]).survival()
    np.testing.assert_array_equal(survival, [[1, 1], [0.5, 1], [0, 1], [0, 0.25]])


def test_stochastic_imagination_follows_its_key() -> None:
    observation, memory = start()
    sampled = jax.jit(lambda key: imagine(DYNAMICS, SCALES, POLICY, observation, memory, horizon=3, key=key))
    once, again, other = (sampled(jax.random.key(i)).observations for i in (0, 0, 1))
    np.testing.assert_array_equal(once, again)
    np.testing.assert_array_equal(once[0], other[0])
    assert (jnp.abs(once[1:] - other[1:]) > 0).all()


def test_stochastic_imagination_draws_the_mixture_anew_at_every_step() -> None:
    batch = 4000
    one, memory = start(batch=1)
    observation = jnp.broadcast_to(one, (batch, O))
    memory = Memory(*(jnp.broadcast_to(x, (batch, MEMORY)) for x in memory))
    imagined = imagine(DYNAMICS, SCALES, POLICY, observation, memory, horizon=2, key=jax.random.key(3))
    noise = []
    for t in range(2):
        observation, action = imagined.observations[t], imagined.actions[t]
        memory = DYNAMICS.remember(memory, observation, action)
        p = DYNAMICS.predict(memory, observation, action)
        noise.append(np.asarray((imagined.observations[t + 1] - observation) / SCALES.delta[None] - p.mean()))
        if t == 0:
            alpha, mean, std = np.exp(p.log_weights)[0, :, None], np.asarray(p.means[0]), np.exp(p.log_stds)[0]
            variance = np.sum(alpha * (std**2 + mean**2), axis=0) - np.sum(alpha * mean, axis=0) ** 2
            np.testing.assert_allclose(noise[0].std(axis=0), np.sqrt(variance), rtol=0.06)
    assert np.abs(np.corrcoef(noise[0].T, noise[1].T)[:O, O:]).max() < 0.08


def test_planning_never_reads_the_scales() -> None:
    observation, memory = start()
    broken = jax.tree.map(lambda x: x * jnp.nan, DYNAMICS.scale_head)
    blind = eqx.tree_at(lambda x: x.scale_head, DYNAMICS, broken)
    imagined = imagine(blind, SCALES, POLICY, observation, memory, horizon=2)
    expected = imagine(DYNAMICS, SCALES, POLICY, observation, memory, horizon=2)
    np.testing.assert_array_equal(imagined.observations, expected.observations)


def state_gradients(detach: bool) -> tuple[jax.Array, Policy]:
    """Of the sum of the last observation, with respect to the first observation and to the policy."""
    observation, memory = start()

    def last(observation: jax.Array, policy: Policy) -> jax.Array:
        imagined = imagine(DYNAMICS, SCALES, policy, observation, memory, horizon=2, detach_policy_input=detach)
        return jnp.sum(imagined.observations[-1])

    return jax.jit(jax.grad(last, argnums=(0, 1)))(observation, POLICY)


def test_the_gradient_passes_the_policy_only_where_it_is_not_detached() -> None:
    observation, memory = start()
    actions = imagine(DYNAMICS, SCALES, POLICY, observation, memory, horizon=2).actions

    def replayed(observation: jax.Array) -> jax.Array:
        """The same two steps with the actions held fixed."""
        state, mind = observation, memory
        for action in actions[:2]:
            mind = DYNAMICS.remember(mind, state, action)
            state = next_observation(state, DYNAMICS.predict(mind, state, action).mean(), SCALES)
        return jnp.sum(state)

    through_states = jax.jit(jax.grad(replayed))(observation)
    detached, full = state_gradients(detach=True), state_gradients(detach=False)
    np.testing.assert_allclose(detached[0], through_states, atol=1e-5)
    assert not np.allclose(full[0], through_states, atol=1e-3)
    for gradient in (detached[1], full[1]):  # in both modes every parameter of the policy is moved
        assert all(leaf.any() for leaf in jax.tree.leaves(gradient))
    assert not np.allclose(detached[1].mlp.output.bias, full[1].mlp.output.bias, atol=1e-4)


def ring(slots: int = 6) -> Ring:
    return Ring.empty(slots, Start(jnp.zeros(O), Memory(jnp.zeros(MEMORY), jnp.zeros(MEMORY)), *jnp.zeros(2)))


def batch_of(value: float, size: int = 2) -> Start:
    """A batch in which every number tells which batch it was."""
    full = jnp.full((size, MEMORY), value)
    return Start(
        jnp.full((size, O), value), Memory(full, full + 0.5), jnp.full(size, value / 10), jnp.full(size, value)
    )


def test_an_empty_ring_gives_weight_zero() -> None:
    observation, memory, weight, depth = ring().sample(8, key=jax.random.key(0))
    assert observation.shape == (8, O) and memory.cell.shape == (8, MEMORY) and depth.shape == (8,)
    assert not weight.any()


def test_a_ring_gives_only_what_was_added() -> None:
    filled = ring().add(batch_of(1.0))
    observation, memory, weight, depth = filled.sample(64, key=jax.random.key(0))
    assert (observation == 1).all() and (depth == 1).all() and (weight == jnp.float32(0.1)).all()
    assert (memory.hidden == 1).all() and (memory.cell == 1.5).all()


def test_a_full_ring_overwrites_its_oldest_rows_first() -> None:
    full = ring()
    for value in range(1, 6):  # five batches of two into six slots
        full = jax.jit(Ring.add)(full, batch_of(float(value)))
        kept = {float(depth) for depth in full.rows.depth if depth}
        assert kept == set(map(float, range(max(1, value - 2), value + 1)))
    assert int(full.added) == 10
    for value in range(6, 12):
        full = full.add(batch_of(float(value)))
        assert 6 <= int(full.added) < 12  # it never overflows
    assert {float(depth) for depth in full.rows.depth} == {9, 10, 11}
    np.testing.assert_array_equal(full.rows.observation[:, 0], full.rows.depth)
    np.testing.assert_array_equal(full.rows.memory.cell[:, 0], full.rows.depth + 0.5)


def test_sampling_a_ring_is_uniform_over_what_it_holds() -> None:
    filled = ring(8)
    for value in range(1, 4):
        filled = filled.add(batch_of(float(value)))
    draws = 6000
    depth = np.asarray(filled.sample(draws, key=jax.random.key(1)).depth)
    counts = np.bincount(depth.astype(int), minlength=4)
    assert counts[0] == 0
    np.testing.assert_allclose(counts[1:] / draws, 1 / 3, atol=0.03)
    assert not np.array_equal(depth, filled.sample(draws, key=jax.random.key(2)).depth)
