"""The multi-step loss of the dynamics: what counts, what must not, and what it moves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.dynamics.fitting import Window, dynamics_loss, mixture_nll, open_loop, open_loop_error, warm_memory
from mbdpg.dynamics.imagination import imagine
from mbdpg.dynamics.mixture import Memory, MixtureDynamics, Scales

O, A, M, BATCH, BURN_IN, LENGTH = 3, 2, 2, 3, 2, 3
TIME = BURN_IN + LENGTH
SCALES = Scales(jnp.asarray([0.5, 1.0, 2.0]), jnp.float32(0.7), jnp.float32(3.0))


@pytest.fixture(scope="module")
def dynamics() -> MixtureDynamics:
    """Small, and away from its start, where heads hardly differ."""
    fresh = MixtureDynamics(O, A, gaussians=M, memory=4, widths=(8, 8), key=jax.random.key(1))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.3, x.shape), jnp.float32), fresh)


def window(seed: int = 0, batch: int = BATCH) -> Window:
    """Episodes that lie wholly in the window; NumPy, so that a test can write into it."""
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return rng.normal(size=(batch, TIME, *shape)).astype(np.float32)

    ones = np.ones((batch, TIME), np.float32)
    return Window(draw(O), np.tanh(draw(A)), draw(O), draw(), draw(), 0 * ones, ones)


@functools.cache
def compiled(burn_in: int = BURN_IN):
    def loss(dynamics: MixtureDynamics, window: Window):
        return dynamics_loss(dynamics, SCALES, window, burn_in=burn_in, likelihood="mixture", mean_weight=0.5)

    return jax.jit(jax.value_and_grad(loss, has_aux=True))


def loss_and_gradient(dynamics: MixtureDynamics, window: Window) -> tuple[float, list[np.ndarray]]:
    (loss, _), gradient = compiled()(dynamics, window)
    return float(loss), [np.asarray(leaf) for leaf in jax.tree.leaves(gradient)]


def overwritten(window: Window, where: tuple) -> Window:
    """Other numbers at some steps, in everything but `valid`."""
    other = window._replace(**{name: getattr(window, name).copy() for name in window._fields})
    for name in set(window._fields) - {"valid"}:
        getattr(other, name)[where] = 0.77 if name != "terminated" else 1.0
    return other


def test_steps_after_an_episodes_end_change_nothing(dynamics: MixtureDynamics) -> None:
    w = window()
    w.terminated[0, BURN_IN] = 1
    w.valid[0, BURN_IN + 1 :] = 0
    loss, gradient = loss_and_gradient(dynamics, w)
    other_loss, other_gradient = loss_and_gradient(dynamics, overwritten(w, (0, slice(BURN_IN + 1, None))))
    assert loss == other_loss
    assert all(np.array_equal(a, b) for a, b in zip(gradient, other_gradient, strict=True))
    w.valid[0, BURN_IN + 1] = 1
    assert loss_and_gradient(dynamics, w)[0] != loss


def test_steps_before_an_episodes_start_change_nothing(dynamics: MixtureDynamics) -> None:
    w = window()
    w.valid[1, : BURN_IN - 1] = 0
    w.valid[2, :BURN_IN] = 0
    loss, gradient = loss_and_gradient(dynamics, w)
    other = overwritten(overwritten(w, (1, slice(0, BURN_IN - 1))), (2, slice(0, BURN_IN)))
    other_loss, other_gradient = loss_and_gradient(dynamics, other)
    assert loss == other_loss
    assert all(np.array_equal(a, b) for a, b in zip(gradient, other_gradient, strict=True))
    assert loss_and_gradient(dynamics, overwritten(w, (1, BURN_IN - 1)))[0] != loss


def test_windows_in_one_batch_count_as_each_alone(dynamics: MixtureDynamics) -> None:
    w = window()
    w.valid[0, BURN_IN + 1 :] = 0
    w.valid[1, :1] = 0
    total, gradients = 0.0, 0.0
    for i in range(BATCH):
        # The same shape, so that nothing is compiled anew: copies of one window.
        alone = jax.tree.map(lambda x, i=i: np.stack([x[i]] * BATCH), w)
        loss, gradient = loss_and_gradient(dynamics, alone)
        steps = w.valid[i, BURN_IN:].sum()
        total += steps * loss
        gradients += steps * np.concatenate([leaf.ravel() for leaf in gradient])
    loss, gradient = loss_and_gradient(dynamics, w)
    count = w.valid[:, BURN_IN:].sum()
    assert loss == pytest.approx(total / count, rel=1e-5)
    np.testing.assert_allclose(np.concatenate([g.ravel() for g in gradient]), gradients / count, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("field", "counts_alive", "counts_at_the_end"),
    [
        ("next_observation", True, True),
        ("reward", True, False),
        ("terminal_reward", False, True),
        ("terminated", True, True),
    ],
)
def test_the_last_step_counts_with_its_own_reward_and_its_state(
    dynamics: MixtureDynamics, field: str, counts_alive: bool, counts_at_the_end: bool
) -> None:
    w = window()
    w.terminated[0, BURN_IN + 1] = 1
    w.valid[0, BURN_IN + 2 :] = 0
    before = loss_and_gradient(dynamics, w)[0]
    for at, counts in ((BURN_IN, counts_alive), (BURN_IN + 1, counts_at_the_end)):
        other = w._replace(**{field: getattr(w, field).copy()})
        getattr(other, field)[0, at] = 1 - getattr(other, field)[0, at]
        assert (loss_and_gradient(dynamics, other)[0] != before) == counts


def test_the_loss_is_numpys_sum_over_steps(dynamics: MixtureDynamics) -> None:
    w = window()
    w.terminated[0, BURN_IN + 1] = 1
    w.valid[0, BURN_IN + 2 :] = 0
    w.valid[1, 0] = 0
    observation, action = jnp.asarray(w.observation), jnp.asarray(w.action)
    memory = warm_memory(dynamics, jax.tree.map(lambda x: jnp.asarray(x[:, :BURN_IN]), w))
    p, reached, memories = open_loop(dynamics, SCALES, observation[:, BURN_IN], memory, action[:, BURN_IN:])
    steps = (w.observation, w.action, w.next_observation)
    before, taken, after = (jnp.swapaxes(jnp.asarray(x[:, BURN_IN:]), 0, 1) for x in steps)
    outcome = dynamics.outcome(memories, before, taken, (after - before) / SCALES.delta.reshape(1, 1, -1))
    parts = dict.fromkeys(("nll", "mean_mse", "reward_mse", "terminal", "continue_bce"), 0.0)
    for i in range(BATCH):
        for t in range(LENGTH):
            if not w.valid[i, BURN_IN + t]:
                continue
            change = (w.next_observation[i, BURN_IN + t] - np.asarray(reached[t, i])) / np.asarray(SCALES.delta)
            one, brought = jax.tree.map(lambda x, t=t, i=i: x[t, i], (p, outcome))
            parts["nll"] += float(mixture_nll(one, jnp.asarray(change), "mixture"))
            parts["mean_mse"] += np.mean((change - np.asarray(one.mean())) ** 2)
            lives = 1 / (1 + np.exp(-float(brought.continue_logit)))
            if w.terminated[i, BURN_IN + t]:
                parts["terminal"] += (float(brought.terminal_reward) - w.terminal_reward[i, BURN_IN + t]) ** 2
                parts["continue_bce"] -= np.log(1 - lives)
            else:
                parts["reward_mse"] += (float(brought.reward) - w.reward[i, BURN_IN + t]) ** 2
                parts["continue_bce"] -= np.log(lives)
    parts = {name: part / w.valid[:, BURN_IN:].sum() for name, part in parts.items()}
    (loss, metrics), _ = compiled()(dynamics, w)
    assert float(loss) == pytest.approx(sum(parts.values()) - 0.5 * parts["mean_mse"], rel=1e-4)
    for name in parts.keys() - {"terminal"}:
        assert float(metrics[f"dynamics/{name}"]) == pytest.approx(parts[name], rel=1e-4), name
    weights = np.exp(p.log_weights)
    entropy = -np.sum(weights * np.asarray(p.log_weights), axis=-1)
    expected = np.average(entropy.T, weights=w.valid[:, BURN_IN:])
    assert float(metrics["dynamics/gate_entropy"]) == pytest.approx(expected, rel=1e-4)


def test_entries_that_never_change_give_a_finite_loss_and_gradient(dynamics: MixtureDynamics) -> None:
    w = window()
    w.observation[..., 0] = w.next_observation[..., 0] = 0
    loss, gradient = loss_and_gradient(dynamics, w)
    assert np.isfinite(loss) and all(np.isfinite(leaf).all() for leaf in gradient)


def test_a_batch_without_any_valid_future_step_is_no_division_by_zero(dynamics: MixtureDynamics) -> None:
    w = window()
    w.valid[:, BURN_IN:] = 0
    loss, gradient = loss_and_gradient(dynamics, w)
    assert loss == 0 and not any(leaf.any() for leaf in gradient)


def test_the_gradient_reaches_memory_trunk_and_every_head(dynamics: MixtureDynamics) -> None:
    w = window()
    w.terminated[0, -1] = 1
    gradient = compiled()(dynamics, w)[1]
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.asarray(leaf).any(), jax.tree_util.keystr(path)
    assert np.asarray(gradient.trunk.output.bias).all()  # means, weights
    assert np.asarray(gradient.scale_head.bias).all()
    assert np.asarray(gradient.outcome_network.output.bias).all()  # reward, terminal reward, continuation
    assert all(part.any() for part in np.split(np.asarray(gradient.lstm.bias), 4))


def test_burning_in_fills_the_memory_with_the_episodes_own_steps(dynamics: MixtureDynamics) -> None:
    w = jax.tree.map(jnp.asarray, window(batch=4))
    starts = np.array([0, 1, 4, TIME])  # of the last, the window holds nothing yet
    valid = jnp.asarray(np.arange(TIME) >= starts[:, None], jnp.float32)
    memory = warm_memory(dynamics, w._replace(valid=valid))
    for i, start in enumerate(starts):
        by_hand = dynamics.initial_memory(())
        for t in range(start, TIME):
            by_hand = dynamics.remember(by_hand, w.observation[i, t], w.action[i, t])
        np.testing.assert_allclose(memory.hidden[i], by_hand.hidden, atol=1e-6)
        np.testing.assert_allclose(memory.cell[i], by_hand.cell, atol=1e-6)


def test_no_burn_in_leaves_the_memory_empty(dynamics: MixtureDynamics) -> None:
    memory = warm_memory(dynamics, jax.tree.map(lambda x: jnp.asarray(x[:, :0]), window(batch=2)))
    assert memory.hidden.shape == (2, 4) and not memory.hidden.any() and not memory.cell.any()


def test_open_loop_is_imagination_with_the_actions_played_back(dynamics: MixtureDynamics) -> None:
    rng = np.random.default_rng(1)
    start = jnp.asarray(rng.normal(size=(BATCH, O)), jnp.float32)
    memory = Memory(*(jnp.asarray(rng.normal(size=(BATCH, 4)), jnp.float32) for _ in range(2)))
    imagined = imagine(dynamics, SCALES, lambda s: jnp.tanh(s[..., :A]), start, memory, horizon=LENGTH)
    actions = jnp.swapaxes(imagined.actions[:-1], 0, 1)
    p, reached, memories = open_loop(dynamics, SCALES, start, memory, actions)
    np.testing.assert_allclose(reached, imagined.observations, atol=1e-5)
    np.testing.assert_allclose(memories.cell[-1], imagined.memory.cell, atol=1e-5)
    outcome = dynamics.outcome(memories, reached[:-1], imagined.actions[:-1], p.mean())
    np.testing.assert_allclose(jax.nn.sigmoid(outcome.continue_logit), imagined.continues, atol=1e-5)


def test_open_loop_error_is_numpys_beside_that_of_no_change(dynamics: MixtureDynamics) -> None:
    w = window(2)
    w.valid[0, BURN_IN + 1 :] = 0  # one window ends after one step
    w.valid[1, 0] = 0
    w = jax.tree.map(jnp.asarray, w)
    errors = open_loop_error(dynamics, SCALES, w, burn_in=BURN_IN)
    memory = warm_memory(dynamics, jax.tree.map(lambda x: x[:, :BURN_IN], w))
    start = w.observation[:, BURN_IN]
    reached = open_loop(dynamics, SCALES, start, memory, w.action[:, BURN_IN:])[1]
    for depth, rows in ((1, [0, 1, 2]), (3, [1, 2])):
        truth = np.asarray(w.next_observation)[rows, BURN_IN + depth - 1]
        for found, guess in zip(errors[depth - 1], (reached[depth], start), strict=True):
            expected = np.sqrt(np.mean((np.asarray(guess)[rows] - truth) ** 2))
            assert float(found) == pytest.approx(expected, rel=1e-5)
