"""Probe environments, each of which isolates one fault (after Andy Jones and rejax), as tables of transitions.

What fails tells where to look: (1) the critics' loss or optimizer; (2) the observation's way into the critics;
(3) discounting, targets, termination; (4) the actor's gradient; (5) the observation's way into the actor.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.agents import mbdpg, td3
from mbdpg.dynamics import mixture
from mbdpg.interfaces import Agent, Batch, EnvSpec

ROWS, BATCH, UPDATES, GAMMA = 512, 32, 500, 0.5
ENV = EnvSpec("probe", observation_size=1, action_size=1, episode_limit=None, reference_return=None)
NETWORKS = {"width": 16, "target_noise": 0.0, "batch_size": BATCH, "discount": GAMMA, "target_update_rate": 0.1}
AGENTS: dict[str, Agent] = {
    "td3": td3.TD3(td3.Config(**NETWORKS, learning_rate=3e-3), ENV),
    "mbdpg": mbdpg.MBDPG(
        mbdpg.Config(
            **NETWORKS,
            **{f"{name}_learning_rate": 3e-3 for name in ("actor", "critic", "dynamics")},
            **{"horizon": 2, "burn_in": 0, "fit_length": 1, "fit_batch_size": BATCH, "memory": 8, "gaussians": 2},
        ),
        ENV,
    ),
}


class Learned(NamedTuple):
    """What a probe asks for."""

    value: Callable[[float, float], float]
    action: Callable[[float], float]


@pytest.fixture(scope="module", params=AGENTS)
def learn(request: pytest.FixtureRequest) -> Callable[..., Learned]:
    """Train an agent on a table of transitions; compiled once for all probes."""
    agent = AGENTS[request.param]
    names = [phase for phase in agent.phases if phase.name in ("fitting", "improving")]

    @jax.jit
    def train(table: Batch, key: jax.Array):
        def step(state, key):
            for i, phase in enumerate(names):
                rows = jax.random.randint(jax.random.fold_in(key, i), (BATCH,), 0, ROWS)
                state, _ = phase.update(state, jax.tree.map(lambda x: x[rows, None], table), key=key)  # noqa: B023
            return state, None

        init_key, loop_key = jax.random.split(key)
        return jax.lax.scan(step, agent.init(key=init_key), jax.random.split(loop_key, UPDATES))[0]

    def trained(table: Batch):
        # In a world without noise the likelihood's gradient grows to hundreds and drowns the reward head's.
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(mixture, "LOG_STD_MIN", -1.0)
            return train(table, jax.random.key(7))

    def learned(observation, action, reward, next_observation, terminated) -> Learned:
        columns = np.broadcast_arrays(*(np.asarray(x, np.float32) for x in (reward, terminated, np.ones(ROWS))))
        reward, terminated, valid = columns
        o, a, after = (
            np.broadcast_to(x, (ROWS,)).astype(np.float32)[:, None] for x in (observation, action, next_observation)
        )
        state = trained(Batch(o, a, reward, after, terminated, valid))

        def one(x: float) -> jax.Array:
            return jnp.full(1, x, jnp.float32)

        return Learned(
            value=lambda observation, action: float(jnp.min(state.critics(one(observation), one(action)))),
            action=lambda observation: float(state.actor(one(observation))[0]),
        )

    return learned


RNG = np.random.default_rng(0)
ACTION = RNG.uniform(-1, 1, ROWS)
SIGN = RNG.choice([-1.0, 1.0], ROWS)
BEST, WORST = 1 / (1 - GAMMA), GAMMA / (1 - GAMMA) - 1
"""The value of a reward of 1 now, or of -1, and of 1 at every step from then on."""


def test_1_a_constant_reward_is_the_value_of_a_single_step(learn: Callable[..., Learned]) -> None:
    learned = learn(0, ACTION, 1, 0, 1)
    assert learned.value(0, 0.3) == pytest.approx(1, abs=0.05)


def test_2_the_value_depends_on_the_observation(learn: Callable[..., Learned]) -> None:
    learned = learn(SIGN, ACTION, SIGN, SIGN, 1)
    assert learned.value(1, 0.3) == pytest.approx(1, abs=0.1)
    assert learned.value(-1, 0.3) == pytest.approx(-1, abs=0.1)


def test_3_a_reward_one_step_away_is_discounted_once(learn: Callable[..., Learned]) -> None:
    second = SIGN > 0  # from -1 to 1 without a reward, and from there to the end with a reward of 1
    learned = learn(SIGN, ACTION, second, 1, second)
    assert learned.value(1, 0.3) == pytest.approx(1, abs=0.1)
    assert learned.value(-1, 0.3) == pytest.approx(GAMMA, abs=0.1)


def test_4_the_actor_finds_the_action_that_pays(learn: Callable[..., Learned]) -> None:
    learned = learn(0, ACTION, -ACTION, 0, 0)
    assert learned.action(0) < -0.9
    assert learned.value(0, -1) == pytest.approx(BEST, abs=0.25)
    assert learned.value(0, 1) == pytest.approx(WORST, abs=0.25)


def test_5_the_actor_finds_the_action_that_pays_where_it_is(learn: Callable[..., Learned]) -> None:
    learned = learn(SIGN, ACTION, SIGN * ACTION, -SIGN, 0)  # the observation changes its sign at every step
    assert learned.action(1) > 0.9 and learned.action(-1) < -0.9
    for sign in (1, -1):
        assert learned.value(sign, sign) == pytest.approx(BEST, abs=0.25)
        assert learned.value(sign, -sign) == pytest.approx(WORST, abs=0.25)
