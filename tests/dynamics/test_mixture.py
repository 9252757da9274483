"""The Mixture Gaussian Network against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.dynamics.fitting import mixture_nll
from mbdpg.dynamics.mixture import (
    LOG_STD_MAX,
    LOG_STD_MIN,
    Memory,
    MixtureDynamics,
    Prediction,
    Scales,
    next_observation,
)
from mbdpg.networks.normalizer import BOUND

O, A, M, MEMORY, BATCH = 3, 2, 4, 5, 6


@pytest.fixture(scope="module")
def dynamics() -> MixtureDynamics:
    return MixtureDynamics(O, A, gaussians=M, memory=MEMORY, widths=(8, 7), key=jax.random.key(1))


def prediction(rng: np.random.Generator, *lead: int) -> Prediction:
    def draw(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=(*lead, *shape)), jnp.float32)

    return Prediction(jax.nn.log_softmax(draw(M)), draw(M, O), 0.5 * draw(M, O))


def pair(rng: np.random.Generator, *lead: int) -> tuple[jax.Array, jax.Array]:
    return tuple(jnp.asarray(rng.normal(size=(*lead, size)), jnp.float32) for size in (O, A))


def log_densities(p: Prediction, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """alpha_i and log p_i(target), without (O / 2) log 2 pi, by loops."""
    log_p = np.zeros((*target.shape[:-1], M))
    for at in np.ndindex(*target.shape[:-1]):
        for i in range(M):
            for o in range(O):
                std = np.exp(float(p.log_stds[at][i, o]))
                log_p[at][i] += -0.5 * ((target[at][o] - float(p.means[at][i, o])) / std) ** 2 - np.log(std)
    return np.exp(np.asarray(p.log_weights, np.float64)), log_p


@pytest.mark.parametrize("likelihood", ["mixture", "eq11"])
def test_the_negative_log_likelihood_is_numpys(likelihood: str) -> None:
    rng = np.random.default_rng(0)
    p, target = prediction(rng, BATCH), rng.normal(size=(BATCH, O)).astype(np.float32)
    alpha, log_p = log_densities(p, target)
    mixture = -np.log(np.sum(alpha * np.exp(log_p), axis=-1)) / O
    expected = mixture if likelihood == "mixture" else -np.sum(alpha * log_p, axis=-1) / O
    np.testing.assert_allclose(mixture_nll(p, jnp.asarray(target), likelihood), expected, rtol=1e-4)


def test_eq_11_is_an_upper_bound_of_the_mixtures_likelihood() -> None:
    rng = np.random.default_rng(1)
    p, target = prediction(rng, 500), jnp.asarray(rng.normal(size=(500, O)), jnp.float32)
    gap = mixture_nll(p, target, "eq11") - mixture_nll(p, target, "mixture")
    assert jnp.min(gap) > -1e-5 and jnp.mean(gap) > 0.1


def test_with_equal_experts_eq_11_and_the_mixtures_likelihood_agree() -> None:
    rng = np.random.default_rng(2)
    p, target = prediction(rng, 50), jnp.asarray(rng.normal(size=(50, O)), jnp.float32)
    same = p._replace(means=p.means[:, :1] + 0 * p.means, log_stds=p.log_stds[:, :1] + 0 * p.log_stds)
    expected = mixture_nll(same, target, "mixture")
    np.testing.assert_allclose(mixture_nll(same, target, "eq11"), expected, rtol=1e-4, atol=1e-4)


def test_a_far_target_has_a_finite_likelihood_and_gradient() -> None:
    p = prediction(np.random.default_rng(3), BATCH)
    far = jnp.full((BATCH, O), 1e4)
    value, gradient = jax.value_and_grad(lambda p: jnp.sum(mixture_nll(p, far, "mixture")))(p)
    assert jnp.isfinite(value) and all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_the_mean_is_the_weighted_sum_of_means() -> None:
    p = prediction(np.random.default_rng(4), 2, BATCH)
    expected = np.zeros((2, BATCH, O))
    for i in range(M):
        expected += np.exp(p.log_weights[..., i, None]) * np.asarray(p.means[..., i, :])
    np.testing.assert_allclose(p.mean(), expected, rtol=1e-5, atol=1e-6)


def test_samples_have_the_mixtures_mean_and_spread() -> None:
    p = prediction(np.random.default_rng(5), 2)
    draws = 20_000
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (draws, *x.shape)), p)
    samples = np.asarray(jax.jit(lambda p, key: p.sample(key=key))(many, jax.random.key(0)))
    alpha, mean, std = np.exp(p.log_weights)[..., None], np.asarray(p.means), np.exp(p.log_stds)
    expected_mean = np.sum(alpha * mean, axis=-2)
    expected_std = np.sqrt(np.sum(alpha * (std**2 + mean**2), axis=-2) - expected_mean**2)
    np.testing.assert_allclose(samples.mean(axis=0), expected_mean, atol=5 * expected_std.max() / np.sqrt(draws))
    np.testing.assert_allclose(samples.std(axis=0), expected_std, rtol=0.05)


def test_a_sample_comes_from_one_gaussian_not_from_their_average() -> None:
    """Eq. 6 taken literally would average; all entries of one sample share a Gaussian, samples in a batch do not."""
    means = jnp.broadcast_to(10.0 * jnp.arange(M, dtype=jnp.float32)[:, None], (M, O))
    log_weights = jnp.log(jnp.asarray([0.1, 0.2, 0.3, 0.4]))
    one = Prediction(log_weights, means, jnp.full((M, O), -5.0))
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (4000, *x.shape)), one)
    samples = np.asarray(many.sample(key=jax.random.key(0))) / 10
    which = np.rint(samples)
    assert np.abs(samples - which).max() < 0.01
    assert (which == which[:, :1]).all()
    np.testing.assert_allclose(np.bincount(which[:, 0].astype(int)) / 4000, [0.1, 0.2, 0.3, 0.4], atol=0.04)


def test_the_memory_is_an_lstm(dynamics: MixtureDynamics) -> None:
    rng = np.random.default_rng(6)
    observation, action = pair(rng, BATCH)
    hidden, cell = (rng.normal(size=(BATCH, MEMORY)).astype(np.float32) for _ in range(2))
    new = dynamics.remember(Memory(jnp.asarray(hidden), jnp.asarray(cell)), observation, action)

    def sigmoid(x: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-x))

    gates = np.concatenate([observation, action, hidden], axis=-1) @ np.asarray(dynamics.lstm.weight)
    write, forget, candidate, read = np.split(gates + np.asarray(dynamics.lstm.bias), 4, axis=-1)
    expected = sigmoid(forget) * cell + sigmoid(write) * np.tanh(candidate)
    np.testing.assert_allclose(new.cell, expected, atol=1e-5)
    np.testing.assert_allclose(new.hidden, sigmoid(read) * np.tanh(expected), atol=1e-5)


def test_a_fresh_memory_is_empty_and_keeps_what_it_holds(dynamics: MixtureDynamics) -> None:
    assert not any(leaf.any() for leaf in dynamics.initial_memory((BATCH,)))
    still = jax.tree.map(jnp.zeros_like, dynamics.lstm.weight)
    held = Memory(jnp.zeros(MEMORY), jnp.ones(MEMORY))
    silent = MixtureDynamics.remember(
        jax.tree.map(lambda x: still if x is dynamics.lstm.weight else x, dynamics), held, jnp.zeros(O), jnp.zeros(A)
    )
    np.testing.assert_allclose(silent.cell, np.full(MEMORY, 1 / (1 + np.exp(-1))), rtol=1e-6)  # sigmoid(1)


def test_every_output_belongs_to_one_head(dynamics: MixtureDynamics) -> None:
    """The slices of the trunk's output neither overlap nor leave one out."""
    observation, action = pair(np.random.default_rng(7))

    def heads(bias: jax.Array) -> Prediction:
        moved = jax.tree.map(lambda x: bias if x is dynamics.trunk.output.bias else x, dynamics)
        return moved.predict(moved.initial_memory(()), observation, action)

    jacobian = jax.jacobian(heads)(dynamics.trunk.output.bias)
    used = [np.abs(leaf).reshape(-1, leaf.shape[-1]).sum(axis=0) > 0 for leaf in jacobian]
    sizes = dict(zip(Prediction._fields, [mask.sum() for mask in used], strict=True))
    assert sizes == {"log_weights": M, "means": M * O, "log_stds": 0}
    assert np.sum(used, axis=0).tolist() == [1] * (M * (O + 1))


def test_a_prediction_is_a_mixture_within_its_bounds(dynamics: MixtureDynamics) -> None:
    observation, action = pair(np.random.default_rng(8), 2, BATCH)
    loud = jax.tree.map(lambda x: 50 * x, dynamics)
    p = loud.predict(loud.initial_memory((2, BATCH)), observation, action)
    assert [leaf.shape[2:] for leaf in p] == [(M,), (M, O), (M, O)]
    np.testing.assert_allclose(jnp.sum(jnp.exp(p.log_weights), axis=-1), 1.0, rtol=1e-5)
    assert jnp.min(p.log_stds) >= LOG_STD_MIN and jnp.max(p.log_stds) <= LOG_STD_MAX
    assert jnp.min(p.log_stds) < LOG_STD_MIN + 1 and jnp.max(p.log_stds) > LOG_STD_MAX - 1


def test_a_fresh_model_expects_to_live_on(dynamics: MixtureDynamics) -> None:
    observation, action = pair(np.random.default_rng(9), BATCH)
    outcome = dynamics.outcome(dynamics.initial_memory((BATCH,)), observation, action, observation)
    assert [leaf.shape for leaf in outcome] == [(BATCH,)] * 3
    assert 0.9 < float(jnp.mean(jax.nn.sigmoid(outcome.continue_logit))) < 0.999


@pytest.mark.parametrize("read", ["observation", "action", "delta", "memory"])
def test_an_outcome_depends_on_the_step_its_change_and_the_memory(dynamics: MixtureDynamics, read: str) -> None:
    observation, action = pair(np.random.default_rng(9), BATCH)
    step = {"observation": observation, "action": action, "delta": observation + 1}
    step["memory"] = Memory(jnp.ones((BATCH, MEMORY)), jnp.ones((BATCH, MEMORY)))
    moved = step | {read: jax.tree.map(lambda x: x + 0.5, step[read])}
    for before, after in zip(dynamics.outcome(**step), dynamics.outcome(**moved), strict=True):
        assert (jnp.abs(before - after) > 0).all()


@pytest.mark.parametrize("lead", [(), (4,), (2, 4)])
def test_the_next_observation_adds_the_change_in_its_units(lead: tuple[int, ...]) -> None:
    rng = np.random.default_rng(10)
    observation, delta = (rng.normal(size=(*lead, O)).astype(np.float32) for _ in range(2))
    factor = np.float32([0.1, 1, 2])
    scales = Scales(jnp.asarray(factor), jnp.ones(()), jnp.ones(()))
    after = next_observation(jnp.asarray(observation), jnp.asarray(delta), scales)
    np.testing.assert_allclose(after, observation + delta * factor, rtol=1e-5)


def test_the_next_observation_stays_within_its_bound_and_passes_a_gradient() -> None:
    scales = Scales(jnp.ones(O), jnp.ones(()), jnp.ones(()))

    def after(delta: jax.Array) -> jax.Array:
        return next_observation(jnp.full(O, 9.0), delta, scales)

    assert jnp.max(after(jnp.full(O, 100.0))) <= BOUND + 1
    assert (jnp.diagonal(jax.jacobian(after)(jnp.full(O, 3.0))) > 0.05).all()
