"""Eq. 14-20 against loops over time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.agents import objectives

H, BATCH, GAMMA = 4, 3, 0.9


def draw(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def expanded(rewards, continues, values, trace: float = 1.0, discount: float = GAMMA) -> np.ndarray:
    arrays = (jnp.asarray(x, jnp.float32) for x in (rewards, continues, values[1:]))
    return np.asarray(objectives.expanded_values(*arrays, discount, trace))


def n_step(rewards, continues, values, t: int, n: int) -> np.ndarray:
    """n imagined rewards from step t, then the value: Eq. 16 with the powers of gamma counted from t."""
    total, alive = np.zeros(BATCH), np.ones(BATCH)
    for h in range(t, t + n):
        total += GAMMA ** (h - t) * alive * rewards[h]
        alive = alive * continues[h]
    return total + GAMMA**n * alive * values[t + n]


CONTINUES = {
    "certain": np.ones((H, BATCH)),
    "deadly": np.zeros((H, BATCH)),
    "soft": np.random.default_rng(9).uniform(0.2, 1, (H, BATCH)),
}


@pytest.mark.parametrize("continues", CONTINUES.values(), ids=CONTINUES.keys())
@pytest.mark.parametrize("trace", [1.0, 0.95, 0.0])
def test_expanded_values_are_the_weighted_sum_of_n_step_returns(continues: np.ndarray, trace: float) -> None:
    rewards, values = draw(H, BATCH), draw(H + 1, BATCH, seed=1)
    expected = np.zeros((H, BATCH))
    for t in range(H):
        last = H - t
        for n in range(1, last + 1):
            weight = trace ** (n - 1) * (1 - trace if n < last else 1)
            expected[t] += weight * n_step(rewards, continues, values, t, n)
    np.testing.assert_allclose(expanded(rewards, continues, values, trace), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("trace", [1.0, 0.95, 0.0])
def test_targets_of_a_value_that_never_changes_are_the_same_at_every_step(trace: float) -> None:
    """With the printed powers, gamma^h, the target at step t would be gamma^t times this."""
    ones = np.ones((H, BATCH))
    targets = expanded(ones, ones, np.full((H + 1, BATCH), 1 / (1 - GAMMA)), trace)
    np.testing.assert_allclose(targets, 1 / (1 - GAMMA), rtol=1e-5)


def test_a_certain_end_keeps_its_own_reward_and_zeroes_everything_after() -> None:
    rewards, values = draw(H, BATCH), draw(H + 1, BATCH, seed=1)
    continues = np.ones((H, BATCH))
    continues[1] = 0  # the second step ends the episode
    targets = expanded(rewards, continues, values)
    np.testing.assert_allclose(targets[0], rewards[0] + GAMMA * rewards[1], rtol=1e-5)
    np.testing.assert_allclose(targets[1], rewards[1], rtol=1e-5)
    later = rewards.copy()
    later[2:] += 100
    np.testing.assert_array_equal(expanded(later, continues, values + 100)[:2], targets[:2])


@pytest.mark.parametrize("trace", [1.0, 0.95, 0.0])
def test_an_exact_value_in_a_linear_world_is_expanded_to_itself(trace: float) -> None:
    """s' = A s + B a, r = w s + u a, a = K s: V(s) = v s, and every target equals Q to float32."""
    rng = np.random.default_rng(3)
    a, b, k = 0.6 * rng.normal(size=(3, 3)) / 2, rng.normal(size=(3, 2)) / 3, rng.normal(size=(2, 3)) / 3
    w, u = rng.normal(size=3), rng.normal(size=2)
    closed = a + b @ k
    v = np.linalg.solve(np.eye(3) - GAMMA * closed.T, w + k.T @ u)
    states = [rng.normal(size=(BATCH, 3))]
    for _ in range(H):
        states.append(states[-1] @ closed.T)
    states = np.stack(states)
    rewards = (states @ w + states @ k.T @ u)[:-1]
    targets = expanded(rewards, np.ones((H, BATCH)), states @ v, trace)
    np.testing.assert_allclose(targets, (states @ v)[:-1], atol=1e-5)


@pytest.mark.parametrize("critics", [1, 2, 3])
@pytest.mark.parametrize("shape", [(BATCH,), (H, BATCH)])
def test_the_critic_loss_is_a_weighted_mean_per_critic(critics: int, shape: tuple[int, ...]) -> None:
    values, targets = draw(critics, *shape), draw(*shape, seed=1)
    weights = np.random.default_rng(2).uniform(0.5, 1, shape).astype(np.float32)
    total = 0.0
    for i in range(critics):
        for at in np.ndindex(*shape):
            total += weights[at] * (values[i][at] - targets[at]) ** 2
    loss = objectives.critic_loss(jnp.asarray(values), jnp.asarray(targets), jnp.asarray(weights))
    assert float(loss) == pytest.approx(total / weights.sum(), rel=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_errors_beyond_delta_pull_no_harder_than_delta_for_their_share(share: float) -> None:
    errors = jnp.asarray([[-30.0, -2.0, -0.5, 0.0, 1.5, 7.0]])

    def loss(values):
        return objectives.critic_loss(values, jnp.zeros(6), jnp.ones(6), huber_delta=2.0, huber_share=share)

    value, slope = jax.value_and_grad(loss)(errors)
    squares, hubers = 900 + 4 + 0.25 + 2.25 + 49, 2 * (60 - 2) + 4 + 0.25 + 2.25 + 2 * (14 - 2)
    assert float(value) == pytest.approx(((1 - share) * squares + share * hubers) / 6, rel=1e-6)
    cut = np.asarray([-2.0, -2.0, -0.5, 0.0, 1.5, 2.0])
    np.testing.assert_allclose(slope[0], 2 * ((1 - share) * errors[0] + share * cut) / 6, rtol=1e-6)


def test_the_critic_loss_moves_values_and_never_targets() -> None:
    def loss(values, targets):
        return objectives.critic_loss(values, targets, jnp.ones(BATCH))

    value_slope, target_slope = jax.grad(loss, argnums=(0, 1))(jnp.asarray(draw(2, BATCH)), jnp.ones(BATCH))
    np.testing.assert_allclose(value_slope, 2 * (draw(2, BATCH) - 1) / BATCH, rtol=1e-5)
    assert not target_slope.any()


def test_the_critic_loss_of_a_batch_without_weight_is_zero() -> None:
    assert float(objectives.critic_loss(jnp.ones((2, BATCH)), jnp.zeros(BATCH), jnp.zeros(BATCH))) == 0


def policy_objective(rewards, values, survival, *, beta: float, reward_weights: str) -> np.ndarray:
    arrays = (jnp.asarray(x, jnp.float32) for x in (rewards, values, survival))
    settings = {"discount": GAMMA, "beta": jnp.float32(beta), "reward_weights": reward_weights}
    return np.asarray(objectives.policy_objective(*arrays, **settings))


@pytest.mark.parametrize("reward_weights", ["uniform", "remaining"])
@pytest.mark.parametrize("first_value", [0, 1, H])
def test_the_policy_objective_is_eq_18(reward_weights: str, first_value: int) -> None:
    rewards, values = draw(H, BATCH), draw(H + 1 - first_value, BATCH, seed=1)
    survival = np.cumprod(np.random.default_rng(2).uniform(0.5, 1, (H + 1, BATCH)), axis=0)
    total = np.zeros(BATCH)
    for t in range(H):
        weight = 0.7 * (min(H - t, len(values)) if reward_weights == "remaining" else 1)
        total += weight * GAMMA**t * survival[t] * rewards[t]
    for t in range(first_value, H + 1):
        total += GAMMA**t * survival[t] * values[t - first_value]
    objective = policy_objective(rewards, values, survival, beta=0.7, reward_weights=reward_weights)
    np.testing.assert_allclose(objective, total / len(values), rtol=1e-4)


@pytest.mark.parametrize("beta", [1.0, 3.0])
@pytest.mark.parametrize("first_value", [0, 1, 2, H])
@pytest.mark.parametrize("reward_weights", ["uniform", "remaining"])
def test_total_weight_of_each_reward_where_values_are_exact(beta: float, first_value: int, reward_weights: str) -> None:
    """methods.md 2.8: how often gamma^k r_{k+1} is counted, directly or inside a value, times the value terms."""
    steps = H + 3
    for k in range(steps):
        rewards = np.zeros((steps, 1))
        rewards[k] = 1
        values = [sum(GAMMA ** (h - t) * rewards[h] for h in range(t, steps)) for t in range(first_value, H + 1)]
        objective = policy_objective(
            rewards[:H], np.stack(values), np.ones((H + 1, 1)), beta=beta, reward_weights=reward_weights
        )
        weight = objective[0] * len(values) / GAMMA**k
        direct = (min(H - k, len(values)) if reward_weights == "remaining" else 1) if k < H else 0
        assert weight == pytest.approx(beta * direct + max(min(k, H) + 1 - first_value, 0), rel=1e-5)
        if reward_weights == "uniform" and first_value == 1:  # as printed
            assert weight == pytest.approx(beta + k if k < H else H, rel=1e-5)
        if reward_weights == "remaining" and beta == 1.0:  # every reward alike
            assert weight == pytest.approx(len(values), rel=1e-5)


def test_the_clipped_value_is_the_smaller_one_and_moves_only_it() -> None:
    values = jnp.asarray([[1.0, 5.0], [2.0, -5.0]])
    np.testing.assert_array_equal(objectives.clipped_value(values), [1, -5])
    slope = jax.grad(lambda v: jnp.sum(objectives.clipped_value(v)))(values)
    np.testing.assert_array_equal(slope, [[1, 0], [0, 1]])


def test_a_terminated_transition_is_worth_its_reward_alone() -> None:
    target = objectives.temporal_difference_target(
        jnp.asarray([1.0, 1.0]), jnp.asarray([0.0, 1.0]), jnp.asarray([10.0, 10.0]), GAMMA
    )
    np.testing.assert_allclose(target, [10, 1])


def test_the_cloning_loss_is_the_mean_squared_distance_of_actions() -> None:
    actions, demonstrated = draw(BATCH, 2), draw(BATCH, 2, seed=1)
    expected = np.mean([np.sum((a - d) ** 2) for a, d in zip(actions, demonstrated, strict=True)])
    loss = objectives.cloning_loss(jnp.asarray(actions), jnp.asarray(demonstrated))
    assert float(loss) == pytest.approx(expected, rel=1e-5)


def test_the_value_bias_is_taken_where_the_return_is_known() -> None:
    metrics = objectives.value_bias(jnp.asarray([3.0, 100.0, 5.0]), jnp.asarray([1.0, np.nan, 2.0]))
    assert {name: float(x) for name, x in metrics.items()} == {"critic/q_bias": 2.5, "critic/realized_return": 1.5}


def test_the_value_bias_where_no_return_is_known_does_not_look_perfect() -> None:
    metrics = objectives.value_bias(jnp.ones(2), jnp.full(2, jnp.nan))
    assert all(np.isnan(float(x)) for x in metrics.values())
