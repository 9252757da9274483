"""Whether what MBDPG climbs knows what one action is worth: asked of the simulator, for MuJoCo's tasks.

    python results/action_slopes.py RUN [--states 50] [--change 0.2] [--steps 900]

In states of one episode of the learned policy one entry of the action is raised and lowered by so much, for one step;
then the policy goes on, in the simulator and in the newest checkpoint's model. Printed is how the difference of the two
discounted returns by every estimate (the critics' value of that action; so many imagined rewards, and a value after
them) correlates with the true one, and the root mean square of both. Nothing is written.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from what_limits import load

from mbdpg.agents import objectives
from mbdpg.dynamics.imagination import imagine
from mbdpg.experiments.compilations import keep_compilations
from mbdpg.interfaces import require
from mbdpg.training.learner import Learner

HORIZONS = 1, 2, 5, 10, 20
ESTIMATES = (
    *("lesser of the critics", "their mean"),
    *(f"{steps} rewards" for steps in HORIZONS),
    *(f"{steps} rewards and the mean" for steps in HORIZONS),
)
FROM, EPISODE = 150, 900
"""Steps of the episode whose states are taken: once the gait has settled, and before a time limit."""


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    agent, env, _, arrays = load(options)
    learner, rng = Learner(agent, [options.seed]), np.random.default_rng(options.seed)
    learner.restore([arrays])
    state, discount = jax.tree.map(lambda leaf: leaf[0], learner.state), agent.config.discount
    policy = learner.policies()[0]
    simulator: Any = env._env.unwrapped  # type: ignore[attr-defined]
    require(hasattr(simulator, "set_state"), f"{env.spec.id} cannot be put in a state, expected a task of MuJoCo's")

    def step(action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        observation, reward, ended, *_ = simulator.step(env._real_action(action))  # type: ignore[attr-defined]
        return observation, float(reward), bool(ended)

    simulator.reset(seed=options.seed)
    observation, passed = simulator._get_obs(), []
    for _ in range(EPISODE):
        passed.append((simulator.data.qpos.copy(), simulator.data.qvel.copy(), observation.astype(np.float32)))
        observation, _, ended = step(policy(observation))
        require(not ended, f"the policy's episode ended after {len(passed)} steps, expected {EPISODE}")
    rows = rng.choice(np.arange(FROM, EPISODE), options.states, replace=False)

    def realized(row: int, action: np.ndarray) -> float:
        simulator.set_state(*passed[row][:2])
        total, weight = 0.0, 1.0
        for _ in range(options.steps):
            observation, reward, ended = step(action)
            total, weight, action = total + weight * reward, weight * discount, policy(observation)
            if ended:
                break
        return total

    now, past = (np.stack([passed[row][2] for row in taken]) for taken in (rows, rows - 1))
    before, chosen = (past, np.stack([policy(one) for one in past])), np.stack([policy(one) for one in now])
    true, found = [], []
    for entry in np.eye(env.spec.action_size, dtype=np.float32):
        low, high = (np.clip(chosen + sign * options.change * entry, -1.0, 1.0) for sign in (-1.0, 1.0))
        true += [realized(row, up) - realized(row, down) for row, down, up in zip(rows, low, high, strict=True)]
        below, above = (estimates(state, discount, before, now, action) for action in (low, high))
        found.append(np.asarray(above - below))
    env.close()
    print(f"true difference {np.sqrt(np.mean(np.square(true))):.3f} in root mean square, {len(true)} of them")
    for name, ours in zip(ESTIMATES, np.concatenate(found, axis=1), strict=True):
        size, alike = np.sqrt(np.mean(np.square(ours))), np.corrcoef(ours, true)[0, 1]
        print(f"{name:24} {size:7.3f}  correlation {alike:5.2f}")


@partial(jax.jit, static_argnames="discount")
def estimates(state: Any, discount: float, before: tuple[Any, Any], now: Any, action: Any) -> Any:
    """What ESTIMATES say of `action` in `now`, after the observations and actions `before`; one row each."""
    dynamics, observation = state.average_dynamics, state.normalizer(now)
    memory = dynamics.remember(dynamics.initial_memory(now.shape[:1]), state.normalizer(before[0]), before[1])
    first = imagine(dynamics, state.scales, lambda _: action, observation, memory, horizon=1)
    last, memory, longest = first.observations[-1], first.memory, max(HORIZONS)
    later = imagine(dynamics, state.scales, state.average_actor, last, memory, horizon=longest - 1)
    powers = discount ** jnp.arange(longest + 1)[:, None]
    rewards = jnp.cumsum(powers[:-1] * jnp.concatenate([first.rewards, later.rewards]), axis=0)
    values = powers[1:] * jnp.mean(state.critics(later.observations, later.actions), axis=0)
    here, reached = state.critics(observation, action), jnp.asarray(HORIZONS) - 1
    direct = jnp.stack([objectives.clipped_value(here), jnp.mean(here, axis=0)])
    return jnp.concatenate([direct, rewards[reached], (rewards + values)[reached]]) * state.return_scale


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--states", type=int, default=50)
    parser.add_argument("--change", type=float, default=0.2, help="of one entry of the action, each way")
    parser.add_argument("--steps", type=int, default=900, help="of which the true return is the discounted sum")
    parser.add_argument("--seed", type=int, default=0)
    keep_compilations()
    asked, settings = parser.parse_known_args()
    asked.settings = settings
    main(asked)
