"""The critics: independent networks behind one call."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.networks.critic import Critics


def shaken(critics: Critics) -> Critics:
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(0.3, 1.0, x.shape), jnp.float32), critics)


@pytest.mark.parametrize("lead", [(), (5,), (2, 5)])
def test_each_critic_is_its_own_network_of_observation_then_action(key: jax.Array, lead: tuple[int, ...]) -> None:
    critics = shaken(Critics(3, 2, (8, 8), key=key))
    rng = np.random.default_rng(1)
    observation = jnp.asarray(rng.normal(size=(*lead, 3)), jnp.float32)
    action = jnp.asarray(rng.normal(size=(*lead, 2)), jnp.float32)
    values = critics(observation, action)
    assert values.shape == (2, *lead)
    for i in range(2):
        alone = jax.tree.map(lambda x, i=i: x[i], critics.mlps)
        expected = alone(jnp.concatenate([observation, action], axis=-1))[..., 0]
        np.testing.assert_allclose(values[i], expected, rtol=1e-5, atol=1e-5)


def test_critics_start_at_value_zero_but_not_alike(key: jax.Array) -> None:
    critics = Critics(3, 2, (8,), count=3, key=key)
    assert critics(jnp.ones((4, 3)), jnp.ones((4, 2))).shape == (3, 4)
    assert not critics(jnp.ones((4, 3)), jnp.ones((4, 2))).any()
    first = np.asarray(critics.mlps.hidden[0].weight)
    assert not np.array_equal(first[0], first[1]) and not np.array_equal(first[1], first[2])


def test_one_critics_value_does_not_move_the_other(key: jax.Array) -> None:
    critics = shaken(Critics(3, 2, (8,), key=key))
    gradient = eqx.filter_grad(lambda c: jnp.sum(c(jnp.ones((4, 3)), jnp.ones((4, 2)))[0]))(critics)
    for leaf in jax.tree.leaves(gradient):
        assert not leaf[1].any()
    assert gradient.mlps.output.bias[0].any()


def test_one_way_back_through_the_critics_serves_the_actor_and_themselves(key: jax.Array) -> None:
    critics = shaken(Critics(3, 2, (8, 8), key=key))
    rng = np.random.default_rng(2)
    observation, action, weights = (
        jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((4, 5, 3), (4, 5, 2), (2, 4, 5))
    )

    def plain(critics: Critics, observation: jax.Array, action: jax.Array) -> jax.Array:
        return jnp.sum(weights * critics(observation, action))

    def ours(critics: Critics, observation: jax.Array, action: jax.Array) -> jax.Array:
        return jnp.sum(weights * critics.with_slopes(observation, action)[0])

    everything = (0, 1, 2)
    value, (by_parameter, *by_input) = jax.value_and_grad(plain, everything)(critics, observation, action)
    np.testing.assert_allclose(ours(critics, observation, action), value, rtol=1e-5)
    nothing, *mine = jax.grad(ours, everything)(critics, observation, action)
    weighed = critics.weighted_gradient(critics.with_slopes(observation, action)[1], weights)
    for found, expected in ((mine, by_input), (weighed, by_parameter)):
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)
    assert not any(leaf.any() for leaf in jax.tree.leaves(nothing))
