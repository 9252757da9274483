"""What can be worked out by hand in a linear world: the gradients of Eq. 18 and 19, and the fixed point of Eq. 16.

The world is an ordinary `MixtureDynamics` without hidden layers, so that its outputs are affine in observation and
action (and rewards in the change of observation too); policy and critics have no hidden layers either.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.agents.mbdpg import MBDPG, Config, State
from mbdpg.agents.mbdpg.state import optimizers
from mbdpg.dynamics.imagination import Start, imagine
from mbdpg.dynamics.mixture import Memory, MixtureDynamics, Scales
from mbdpg.interfaces import Batch, EnvSpec
from mbdpg.networks.critic import Critics
from mbdpg.networks.mlp import MLP, Linear
from mbdpg.networks.policy import Policy

O, A, M, MEMORY, BATCH, GAMMA = 3, 2, 2, 4, 8, 0.9
BETA, BETAS = 0.6, {"beta": 0.5, "final_beta": 0.9}  # a quarter of the way
ENV = EnvSpec("made-in-code", observation_size=O, action_size=A, episode_limit=None, reference_return=None)
ALPHA = np.array([0.3, 0.7])
DELTA, REWARD, TERMINAL_REWARD = np.array([0.5, 1.0, 2.0]), 0.7, 3.0


def affine(rng: np.random.Generator, inputs: int, outputs: int, spread: float = 0.2) -> Linear:
    """Random weights and a smaller random bias."""
    linear = Linear(inputs, outputs, key=jax.random.key(0))
    weight, bias = rng.normal(0, spread, (inputs, outputs)), rng.normal(0, spread / 4, outputs)
    return eqx.tree_at(
        lambda x: (x.weight, x.bias), linear, (jnp.asarray(weight, jnp.float32), jnp.asarray(bias, jnp.float32))
    )


def without_layers(network: MLP, output: Linear) -> MLP:
    return eqx.tree_at(lambda x: (x.hidden, x.norms, x.output), network, ((), (), output))


def linear_dynamics(rng: np.random.Generator, survival: float) -> MixtureDynamics:
    """Means and both rewards affine in what they see, blind to the memory; weights and survival constant."""
    dynamics = MixtureDynamics(O, A, gaussians=M, memory=MEMORY, widths=(8,), key=jax.random.key(0))
    output = affine(rng, O + A + MEMORY, M * (O + 1), 0.1)
    gates = slice(M * O, M * O + M)
    weight = output.weight.at[O + A :].set(0.0).at[:, gates].set(0.0)
    bias = output.bias.at[gates].set(jnp.log(jnp.asarray(ALPHA, jnp.float32)))
    trunk = without_layers(dynamics.trunk, eqx.tree_at(lambda x: (x.weight, x.bias), output, (weight, bias)))
    outcome = affine(rng, O + A + O + MEMORY, 3, 0.3)
    weight = outcome.weight.at[O + A + O :].set(0.0).at[:, -1].set(0.0)
    bias = outcome.bias.at[-1].set(np.inf if survival == 1 else np.log(survival / (1 - survival)))
    outcome = eqx.tree_at(lambda x: (x.weight, x.bias), outcome, (weight, bias))
    heads = affine(rng, O + A + MEMORY, M * O), without_layers(dynamics.outcome_network, outcome)
    return eqx.tree_at(lambda x: (x.trunk, x.scale_head, x.outcome_network), dynamics, (trunk, *heads))


@functools.cache
def world(survival: float = 0.8) -> State:
    """A state of the agent that lives in the linear world, with policy and critics of one layer."""
    rng = np.random.default_rng(0)
    agent = MBDPG(Config(batch_size=BATCH, burn_in=0, width=8, memory=MEMORY, gaussians=M), ENV)
    state = jax.jit(lambda key: agent.init(key=key))(jax.random.key(0))
    actor = Policy(O, A, (), key=jax.random.key(0))
    actor = eqx.tree_at(lambda x: x.mlp, actor, without_layers(actor.mlp, affine(rng, O, A, 0.5)))
    critics = Critics(O, A, (), key=jax.random.key(0))
    two = jax.tree.map(lambda *x: jnp.stack(x), *(affine(rng, O + A, 1, 0.5) for _ in range(2)))
    critics = eqx.tree_at(lambda x: x.mlps, critics, without_layers(critics.mlps, two))
    scales = Scales(jnp.asarray(DELTA, jnp.float32), jnp.float32(REWARD), jnp.float32(TERMINAL_REWARD))
    parts = {"average_dynamics": linear_dynamics(rng, survival), "scales": scales, "progress": jnp.float32(0.25)}
    parts |= dict.fromkeys(("actor", "target_actor", "average_actor"), actor)
    parts |= dict.fromkeys(("critics", "target_critics"), critics)
    return eqx.tree_at(lambda x: [getattr(x, name) for name in parts], state, list(parts.values()))


def mortal_world() -> State:
    """The same, but that survival depends on the state, the action and the change."""
    return eqx.tree_at(
        lambda x: x.average_dynamics.outcome_network.output.weight,
        world(),
        replace_fn=lambda w: w.at[: 2 * O + A, -1].set(0.7),
    )


def in_numpy(dynamics: MixtureDynamics) -> tuple[np.ndarray, ...]:
    """d, w and v with s' = s + d [s a 1], r = w [s a 1] and terminal reward v [s a 1], in units of value."""
    weight = np.asarray(dynamics.trunk.output.weight, np.float64)[: O + A]
    rows = np.concatenate([weight, np.asarray(dynamics.trunk.output.bias, np.float64)[None]])
    means = rows[:, : M * O].reshape(O + A + 1, M, O)
    d = np.einsum("m,imo->oi", ALPHA, means) * DELTA[:, None]
    head = dynamics.outcome_network.output
    weight, bias = np.asarray(head.weight, np.float64), np.asarray(head.bias, np.float64)
    now, change = np.concatenate([weight[: O + A], bias[None]]), weight[O + A : O + A + O]
    rewards = now + (d / DELTA[:, None]).T @ change
    return d, rewards[:, 0] * REWARD, rewards[:, 1] * TERMINAL_REWARD


KEY = jax.random.key(0)  # unused: planning is deterministic
REAL = jnp.zeros((BATCH, O)), jnp.zeros((BATCH, A))
"""Of which the actor's loss is no function."""


def start_states() -> Start:
    observation = jnp.asarray(np.random.default_rng(1).normal(size=(BATCH, O)), jnp.float32)
    still = jnp.zeros((BATCH, MEMORY))
    return Start(observation, Memory(still, still), jnp.ones(BATCH), jnp.zeros(BATCH))


def policy_gradient(state: State, start: Start, **settings) -> tuple[Policy, dict[str, jax.Array]]:
    """The derivative of J, not of the loss -J, and what else the actor's loss returns."""
    settings = {"saturation_penalty": 0.0, "batch_size": BATCH, "discount": GAMMA} | BETAS | settings
    agent = MBDPG(Config(**settings), ENV)
    gradient, (_, _, metrics) = jax.jit(jax.grad(agent._actor_loss, has_aux=True))(state.actor, state, REAL, start, KEY)
    return jax.tree.map(jnp.negative, gradient), metrics


def hand_written_eq_19(state: State, start: Start, horizon: int, first_value: int, weights: list[float]) -> np.ndarray:
    """Eqs. 19 and 20, one sample and one step at a time; parameters in the order of W (O x A), then b (A)."""
    d, w, v = in_numpy(state.average_dynamics)
    weight, bias = (np.asarray(x, np.float64) for x in (state.actor.mlp.output.weight, state.actor.mlp.output.bias))
    mlps = state.critics.mlps.output
    q = np.concatenate([np.asarray(mlps.weight, np.float64)[..., 0], np.asarray(mlps.bias, np.float64)], axis=1)
    survival = float(jax.nn.sigmoid(state.average_dynamics.outcome_network.output.bias[-1]))
    reward = survival * w + (1 - survival) * v
    total = np.zeros((O + 1) * A)
    for s in np.asarray(start.observation, np.float64):
        ds = np.zeros((O, total.size))  # grad_theta s_0
        for t in range(horizon + 1):
            a = np.tanh(s @ weight + bias)
            # grad_theta mu(s) at a fixed state
            da = np.concatenate([np.kron(s[None], np.eye(A)), np.eye(A)], axis=1) * (1 - a**2)[:, None]
            x = np.concatenate([s, a, [1]])
            if t >= first_value:
                smaller = q[np.argmin(q @ x)]
                total += GAMMA**t * survival**t * smaller[O : O + A] @ da
            if t < horizon:
                total += BETA * weights[t] * GAMMA**t * survival**t * (reward[:O] @ ds + reward[O : O + A] @ da)
                ds = ds + d[:, :O] @ ds + d[:, O : O + A] @ da  # Eq. 20
                s = s + d @ x
    return total / (horizon + 1 - first_value) / len(start.observation)


def flat(gradient: Policy) -> np.ndarray:
    return np.concatenate([np.asarray(gradient.mlp.output.weight).ravel(), np.asarray(gradient.mlp.output.bias)])


@pytest.mark.parametrize(("first_value", "reward_weights"), [(1, "uniform"), (0, "remaining")])
def test_the_eq19_gradient_is_the_hand_written_recursion(first_value: int, reward_weights: str) -> None:
    horizon = 3
    state, start = world(), start_states()
    settings = {"horizon": horizon, "first_value": first_value, "reward_weights": reward_weights}
    gradient, metrics = policy_gradient(state, start, gradient="eq19", **settings)
    assert abs(metrics["actor/objective"]) < 1  # so the loss is not divided by its size
    weights = [horizon - t if reward_weights == "remaining" else 1 for t in range(horizon)]
    expected = hand_written_eq_19(state, start, horizon, first_value, weights)
    np.testing.assert_allclose(flat(gradient), expected, rtol=1e-4, atol=1e-6)
    full, _ = policy_gradient(state, start, gradient="full", **settings)
    assert np.abs(flat(full) - expected).max() > 0.01


def test_both_critics_decide_in_the_eq19_test() -> None:
    state, start = world(), start_states()
    imagined = imagine(state.average_dynamics, state.scales, state.actor, start.observation, start.memory, horizon=3)
    which = jnp.argmin(state.critics(imagined.observations, imagined.actions), axis=0)
    assert 0 < jnp.mean(which.astype(jnp.float32)) < 1


def test_without_rewards_the_eq19_gradient_is_that_of_ordinary_dpg() -> None:
    state, start, unpaid = mortal_world(), start_states(), {"beta": 0.0, "final_beta": 0.0}
    gradient, metrics = policy_gradient(state, start, gradient="eq19", horizon=1, first_value=0, **unpaid)
    assert abs(metrics["actor/objective"]) < 1  # so the loss is not divided by its size
    after = imagine(state.average_dynamics, state.scales, state.actor, start.observation, start.memory, horizon=1)

    def deterministic_policy_gradient(actor: Policy) -> jax.Array:
        total = jnp.zeros(())
        for t, survival in enumerate(after.survival()):
            states = after.observations[t]  # a batch of given states
            total += GAMMA**t * jnp.mean(survival * jnp.min(state.critics(states, actor(states)), axis=0))
        return total / 2

    expected = jax.grad(deterministic_policy_gradient)(state.actor)
    np.testing.assert_allclose(flat(gradient), flat(expected), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("first_value", "reward_weights"), [(1, "uniform"), (0, "remaining"), (3, "remaining")])
def test_the_full_gradient_is_that_of_finite_differences(first_value: int, reward_weights: str) -> None:
    """In float64, in the linear world's bends: tanh of the policy, the minimum of the critics, survival."""
    settings = {"horizon": 3, "first_value": first_value, "reward_weights": reward_weights}
    agent = MBDPG(Config(saturation_penalty=0.0, discount=GAMMA, **BETAS, **settings), ENV)
    everything = mortal_world(), REAL, start_states()
    with jax.enable_x64(True):
        state, real, start = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, everything)
        loss = jax.jit(agent._actor_loss)
        gradient = jax.jit(jax.grad(agent._actor_loss, has_aux=True))(state.actor, state, real, start, KEY)[0]
        assert abs(loss(state.actor, state, real, start, KEY)[1][2]["actor/objective"]) < 1
        rng = np.random.default_rng(0)
        for _ in range(5):
            along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), state.actor)
            ahead, behind = (
                float(loss(jax.tree.map(lambda x, y, e=e: x + e * y, state.actor, along), state, real, start, KEY)[0])
                for e in (1e-5, -1e-5)
            )
            slope = sum(float(jnp.sum(g * y)) for g, y in zip(*map(jax.tree.leaves, (gradient, along)), strict=True))
            assert slope == pytest.approx((ahead - behind) / 2e-5, rel=1e-4)


def test_the_actors_loss_is_scaled_by_the_objectives_size_without_a_gradient_through_it() -> None:
    state, start = world(), start_states()
    gradient, _ = policy_gradient(state, start, horizon=2)
    scaled = eqx.tree_at(lambda x: x.critics, state, jax.tree.map(lambda x: 100 * x, state.critics))
    large, metrics = policy_gradient(scaled, start, horizon=2, **{name: 100 * beta for name, beta in BETAS.items()})
    ratio = np.linalg.norm(flat(large)) / np.linalg.norm(flat(gradient))
    np.testing.assert_allclose(flat(large), ratio * flat(gradient), rtol=1e-3, atol=1e-5)
    assert 0 < ratio < 100
    assert abs(float(metrics["actor/objective"])) > 1


def exact(state: State) -> State:
    """Policy constant, survival certain, both critics (and targets) equal to the true Q of this world."""
    d, w, _ = in_numpy(state.average_dynamics)
    action = np.tanh(np.asarray(state.actor.mlp.output.bias, np.float64))
    # V(s) = v s + c with a constant action: v = w_s + gamma (I + d_s)' v.
    v = np.linalg.solve(np.eye(O) - GAMMA * (np.eye(O) + d[:, :O]).T, w[:O])
    fixed = np.concatenate([action, [1]])
    c = (w[O:] @ fixed + GAMMA * v @ d[:, O:] @ fixed) / (1 - GAMMA)
    q = w + GAMMA * d.T @ v
    q[:O] += GAMMA * v
    q[-1] += GAMMA * c
    weight = jnp.asarray(np.tile(q[: O + A, None], (2, 1, 1)), jnp.float32)
    bias = jnp.asarray(np.tile(q[-1:], (2, 1)), jnp.float32)
    critics = eqx.tree_at(lambda x: (x.mlps.output.weight, x.mlps.output.bias), state.critics, (weight, bias))
    still = eqx.tree_at(lambda x: x.mlp.output.weight, state.actor, jnp.zeros((O, A)))
    return eqx.tree_at(
        lambda x: (x.critics, x.target_critics, x.actor, x.target_actor), state, (critics, critics, still, still)
    )


@pytest.mark.parametrize(("trace", "imagination_ratio"), [(1.0, 0.0), (0.95, 0.5)])
def test_exact_critics_are_a_fixed_point(trace: float, imagination_ratio: float) -> None:
    """Real and imagined targets at once: powers of gamma, rewards' units, where the imagined trajectory is joined."""
    state = exact(world(survival=1.0))
    agent = MBDPG(
        Config(
            horizon=3,
            batch_size=BATCH,
            burn_in=0,
            discount=GAMMA,
            trace=trace,
            target_noise=0.0,
            imagination_ratio=imagination_ratio,
        ),
        ENV,
    )
    d, w, _ = in_numpy(state.average_dynamics)
    rng = np.random.default_rng(2)
    s, a = rng.normal(size=(BATCH, 1, O)), rng.uniform(-1, 1, (BATCH, 1, A))
    x = np.concatenate([s, a, np.ones((BATCH, 1, 1))], axis=-1)
    ones = np.ones((BATCH, 1), np.float32)
    batch = Batch(*(np.float32(y) for y in (s, a, x @ w, s + x @ d.T)), 0 * ones, ones)
    batch = jax.tree.map(jnp.asarray, batch)
    of = optimizers(agent.config)
    state = eqx.tree_at(
        lambda y: (y.critic_optimizer, y.actor_optimizer),
        state,
        (of.critic.init(state.critics), of.actor.init(state.actor)),
    )
    improve = jax.jit(lambda s, b: agent.improve(s, b, key=jax.random.key(0)))
    values = state.critics(batch.observation[:, 0], batch.action[:, 0])
    assert jnp.std(values) > 0.3
    after, metrics = improve(state, batch)
    assert float(metrics["critic/loss"]) < 1e-9
    if imagination_ratio > 0:  # now from the buffer's states too
        assert (after.imagined.rows.weight[:BATCH] == 1).all()
        assert jnp.max(jnp.abs(after.imagined.rows.observation)) < 7  # no bound is near
        again = eqx.tree_at(lambda y: y.imagined, state, after.imagined)
        later, metrics = improve(again, batch)
        assert float(metrics["critic/loss"]) < 1e-9
        assert (later.imagined.rows.depth[BATCH : 2 * BATCH] > 3).any()  # imagination did go on from there
    wrong = batch._replace(reward=batch.reward + 0.1)
    assert float(improve(state, wrong)[1]["critic/loss"]) == pytest.approx(2 * 0.01, rel=1e-3)
