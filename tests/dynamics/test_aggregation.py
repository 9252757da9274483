"""Several networks as one model: what they predict together, and which of them learns."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.dynamics.aggregation import Aggregate
from mbdpg.dynamics.fitting import Window, dynamics_loss, open_loop_error
from mbdpg.dynamics.mixture import MixtureDynamics, Scales

O, A, BATCH, BURN_IN, LENGTH = 3, 2, 4, 2, 3
SCALES = Scales(jnp.full(O, 0.5), jnp.ones(()), jnp.ones(()))


def members(count: int = 3) -> tuple[MixtureDynamics, ...]:
    keys = jax.random.split(jax.random.key(0), count)
    return tuple(MixtureDynamics(O, A, gaussians=1, memory=4, widths=(5, 5), key=key) for key in keys)


def window() -> Window:
    rng, shape = np.random.default_rng(0), (BATCH, BURN_IN + LENGTH)
    observation = rng.normal(size=(BATCH, BURN_IN + LENGTH + 1, O))
    ones, arrays = np.ones(shape), (observation[:, :-1], rng.uniform(-1, 1, (*shape, A)), observation[:, 1:])
    found = Window(*arrays, reward=ones, terminal_reward=ones, terminated=0 * ones, valid=ones)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), found)


@pytest.mark.parametrize(("kind", "together"), [("bagging", np.mean), ("boosting", np.sum)])
def test_they_predict_the_mean_or_the_sum_of_what_each_predicts(kind: str, together: Callable[..., np.ndarray]) -> None:
    parts, w = members(), window()
    whole = Aggregate(parts, kind)
    observation, action = w.observation[:, 0], w.action[:, 0]
    memory = whole.initial_memory((BATCH,))
    assert memory.hidden.shape == (BATCH, 12)
    for _ in range(2):
        memory = whole.remember(memory, observation, action)
    expected = []
    for part in parts:
        own = part.initial_memory((BATCH,))
        for _ in range(2):
            own = part.remember(own, observation, action)
        expected.append(np.asarray(part.predict(own, observation, action).mean()))
    found = whole.predict(memory, observation, action)
    np.testing.assert_allclose(found.mean(), together(np.stack(expected), axis=0), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found.log_stds, parts[-1].predict(own, observation, action).log_stds)


def test_only_the_last_of_boosted_members_learns_and_what_the_others_leave() -> None:
    whole = Aggregate(members(), "boosting")

    def loss(model: Aggregate) -> jax.Array:
        return dynamics_loss(model, SCALES, window(), burn_in=BURN_IN, likelihood="mixture", mean_weight=1.0)[0]

    gradient = jax.jit(jax.grad(loss))(whole)
    sizes = [max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(member)) for member in gradient.members]
    assert sizes[0] == sizes[1] == 0.0 and sizes[2] > 0.0
    moved = eqx.tree_at(lambda m: m.members[0].trunk.output.bias, whole, replace_fn=lambda bias: bias + 1.0)
    assert float(loss(moved)) != float(loss(whole))


def test_one_member_is_as_good_as_itself() -> None:
    (one,) = members(1)
    expected = open_loop_error(one, SCALES, window(), burn_in=BURN_IN)
    for kind in ("bagging", "boosting"):
        np.testing.assert_allclose(
            open_loop_error(Aggregate((one,), kind), SCALES, window(), burn_in=BURN_IN), expected
        )
