"""Probe environments, each of which isolates one fault (after Andy Jones and rejax).

What fails tells where to look: (1) the critics' loss or optimizer; (2) the observation's way into the critics;
(3) discounting, targets, termination; (4) the actor's gradient; (5) the observation's way into the actor.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.agents import mbdpg, mbpo, pets, sac, td3
from mbdpg.dynamics import mixture
from mbdpg.dynamics.planning import Planner
from mbdpg.interfaces import Agent, Batch, EnvSpec

ROWS, STEPS, BATCH, UPDATES, GAMMA = 512, 3, 32, 800, 0.5
ENV = EnvSpec("probe", observation_size=1, action_size=1, episode_limit=None, reference_return=None)
NETWORKS = {"width": 16, "batch_size": BATCH, "discount": GAMMA, "target_update_rate": 0.1}
SOFT = {"learning_rate": 3e-3, "entropy_per_action": -9.0, "initial_temperature": 1e-3}
AGENTS: dict[str, Agent] = {
    "td3": td3.TD3(td3.Config(**NETWORKS, learning_rate=3e-3, target_noise=0.0), ENV),
    "sac": sac.SAC(sac.Config(**NETWORKS, **SOFT), ENV),
    # Half of its steps are real: imagination has the policy's actions alone, and probes ask for others too.
    "mbpo": mbpo.MBPO(
        mbpo.Config(
            **{**NETWORKS, **SOFT, "real_share": 0.5, "members": 3, "elites": 2, "dynamics_width": 16},
            **{"dynamics_learning_rate": 3e-3, "fit_batch_size": BATCH, "rollouts_per_step": 32, "imagine_every": 1},
            retained_steps=20,
        ),
        ENV,
    ),
    "pets": pets.PETS(
        pets.Config(
            **{"members": 3, "dynamics_width": 16, "dynamics_learning_rate": 3e-3, "fit_batch_size": BATCH},
            **{"discount": GAMMA, "horizon": 6, "population": 200, "plan_elites": 20, "iterations": 20},
        ),
        ENV,
    ),
    "mbdpg": mbdpg.MBDPG(
        mbdpg.Config(
            **NETWORKS,
            target_noise=0.0,
            **{f"{name}_learning_rate": 3e-3 for name in ("actor", "critic", "dynamics")},
            # Imagination sees memories of up to three steps, and so must fitting.
            **{"horizon": 2, "burn_in": 0, "fit_length": 3, "fit_batch_size": BATCH, "memory": 8, "gaussians": 2},
        ),
        ENV,
    ),
}
Probe = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Reward, next observation and end, from observation and action."""


class Learned(NamedTuple):
    """What a probe asks for."""

    value: Callable[[float, float], float]
    action: Callable[[float], float]


def experience(probe: Probe, starts: list[float]) -> Batch:
    """Episodes of up to three steps with random actions; no step is valid after the end."""
    rng = np.random.default_rng(0)
    observation, valid, steps = rng.choice(starts, ROWS), np.ones(ROWS), []
    for _ in range(STEPS):
        action = rng.uniform(-1, 1, ROWS)
        reward, after, ends = (np.broadcast_to(x, ROWS) for x in probe(observation, action))
        steps.append(Batch(observation[:, None], action[:, None], reward, after[:, None], ends, valid))
        observation, valid = after, valid * (1 - ends)
    return jax.tree.map(lambda *x: np.stack(x, axis=1).astype(np.float32), *steps)


@pytest.fixture(scope="module", params=AGENTS)
def learn(request: pytest.FixtureRequest) -> Callable[[Probe, list[float]], Learned]:
    """Train an agent on a probe; compiled once for all of them."""
    agent = AGENTS[request.param]
    phases = [phase for phase in agent.phases if phase.name in ("fitting", "judging", "imagining", "improving")]

    @jax.jit
    def train(windows: Batch, key: jax.Array):
        def step(state, key):
            for i, phase in enumerate(phases):
                rows = jax.random.randint(jax.random.fold_in(key, i), (phase.sampling.batch_size,), 0, ROWS)
                length = phase.sampling.burn_in + phase.sampling.length
                batch = jax.tree.map(lambda x, rows=rows, length=length: x[rows, :length], windows)
                state, _ = phase.update(state, batch, key=key)
            return state, None

        init_key, loop_key = jax.random.split(key)
        return jax.lax.scan(step, agent.init(key=init_key), jax.random.split(loop_key, UPDATES))[0]

    def one(x: float) -> jax.Array:
        return jnp.full(1, x, jnp.float32)

    def learned(probe: Probe, starts: list[float]) -> Learned:
        with pytest.MonkeyPatch.context() as patch:
            # Where nothing is random the likelihood's gradient grows by the hundred and starves the reward's.
            patch.setattr(mixture, "LOG_STD_MIN", -1.0)
            state = train(experience(probe, starts), jax.random.key(0))
        if isinstance(agent, pets.PETS):
            return planned(agent.policy(state)[0])
        critics = state.soft.critics if isinstance(state, mbpo.State) else state.critics
        return Learned(
            value=lambda observation, action: float(jnp.min(critics(one(observation), one(action)))),
            action=lambda observation: float(agent.policy(state)[0](one(observation))[0]),
        )

    def planned(planner: Planner) -> Learned:
        plan = jax.jit(lambda x: planner.plan(x, jnp.zeros((planner.horizon, 1)), key=jax.random.key(1)))

        def value(observation: float, action: float) -> float:
            plans = plan(one(observation)).at[0].set(action)[None]
            return float(planner.imagined_return(one(observation), plans, key=jax.random.key(2))[0])

        return Learned(value, lambda observation: float(plan(one(observation))[0, 0]))

    return learned


BEST, WORST = 1 / (1 - GAMMA), GAMMA / (1 - GAMMA) - 1
"""The value of a reward of 1 now, or of -1, and of 1 at every step from then on."""


def test_1_a_constant_reward_is_the_value_of_a_single_step(learn: Callable[..., Learned]) -> None:
    learned = learn(lambda s, a: (1, s, 1), [0])
    assert learned.value(0, 0.3) == pytest.approx(1, abs=0.05)


def test_2_the_value_depends_on_the_observation(learn: Callable[..., Learned]) -> None:
    learned = learn(lambda s, a: (s, s, 1), [-1, 1])
    assert learned.value(1, 0.3) == pytest.approx(1, abs=0.1)
    assert learned.value(-1, 0.3) == pytest.approx(-1, abs=0.1)


def test_3_a_reward_one_step_away_is_discounted_once(learn: Callable[..., Learned]) -> None:
    # From -1 to 1 without a reward, and from there to the end with a reward of 1.
    learned = learn(lambda s, a: (s > 0, np.ones(ROWS), s > 0), [-1, 1])
    assert learned.value(1, 0.3) == pytest.approx(1, abs=0.1)
    assert learned.value(-1, 0.3) == pytest.approx(GAMMA, abs=0.1)


def test_4_the_actor_finds_the_action_that_pays(learn: Callable[..., Learned]) -> None:
    learned = learn(lambda s, a: (-a, s, 0), [0])
    assert learned.action(0) < -0.9
    assert learned.value(0, -1) == pytest.approx(BEST, abs=0.25)
    assert learned.value(0, 1) == pytest.approx(WORST, abs=0.25)


def test_5_the_actor_finds_the_action_that_pays_where_it_is(learn: Callable[..., Learned]) -> None:
    learned = learn(lambda s, a: (s * a, -s, 0), [-1, 1])  # the observation changes its sign at every step
    assert learned.action(1) > 0.9 and learned.action(-1) < -0.9
    for sign in (1, -1):
        assert learned.value(sign, sign) == pytest.approx(BEST, abs=0.25)
        assert learned.value(sign, -sign) == pytest.approx(WORST, abs=0.25)
