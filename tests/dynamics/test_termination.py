"""The known rules of termination, against the simulators whose rules they are."""

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.dynamics.termination import RULES, known_rule
from mbdpg.interfaces import EnvSpec, UserError


def spec(env: str) -> EnvSpec:
    return EnvSpec(env, 1, 1, None, None)


@pytest.mark.filterwarnings("ignore:.*out of date")  # v4 is, on purpose
@pytest.mark.parametrize("env", ["Hopper-v5", "Hopper-v4", "Walker2d-v5", "Ant-v5", "Ant-v4"])
def test_a_rule_ends_where_the_simulator_does(env: str) -> None:
    simulator, rule, ends = gymnasium.make(env), RULES[known_rule(spec(env))], 0
    simulator.action_space.seed(0)
    after, expected = [], []
    for episode in range(40):
        simulator.reset(seed=episode)
        # Ants seldom fall by themselves.
        simulator.unwrapped.data.qvel[2] += 6.0 * (episode % 2)  # type: ignore[attr-defined]
        for _ in range(60):
            observation, _, terminated, truncated, _ = simulator.step(simulator.action_space.sample())
            after.append(observation)
            expected.append(not terminated)
            ends += terminated
            if terminated or truncated:
                break
    simulator.close()
    assert ends > 5
    np.testing.assert_array_equal(rule(jnp.asarray(np.stack(after), jnp.float32)), expected)


@pytest.mark.parametrize("name", ["HalfCheetah", "Swimmer", "Reacher", "Pendulum"])
def test_tasks_without_an_end_go_on(name: str) -> None:
    assert RULES[name](jnp.full((3, 2), jnp.inf)).tolist() == [True] * 3


def test_a_rule_that_nobody_told_us_is_refused_with_those_that_are_known() -> None:
    for env in ("BipedalWalker-v3", "Hopper-v3", "Hopper", "MyHopper-v5"):
        with pytest.raises(UserError, match=f"--termination is known, but the rule of {env} is not; expected"):
            known_rule(spec(env))
    assert known_rule(spec("Pendulum-v1")) == "Pendulum"
