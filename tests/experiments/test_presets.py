"""The `paper` preset holds every number that Gao et al. 2022 state; the sections are given beside each."""

from __future__ import annotations

import dataclasses

import gymnasium
import jax
import pytest

from mbdpg.agents import mbdpg, sac, td3
from mbdpg.experiments.config import CONFIGS, RunConfig
from mbdpg.experiments.presets import PAPER, TASKS, agent_config, run_settings
from mbdpg.interfaces import EnvSpec, UserError
from mbdpg.training.loop import Schedule

STATED = {
    "width": 256,  # 5.1: three dense layers of size 256
    "random_steps": 4000,  # 5.1: 4,000 time steps of random data
    "batch_size": 128,  # 5.1: batches of 128
    "fit_batch_size": 128,
    "actor_learning_rate": 2e-4,  # 5.1: learning rate 2e-4 for dynamics, critic and actor
    "critic_learning_rate": 2e-4,
    "dynamics_learning_rate": 2e-4,
    "discount": 0.99,  # 5.1
    "gaussians": 5,  # 5.3.1: no gain beyond n = 5
    "fit_length": 10,  # 5.3.1: L = 10
    "horizon": 20,  # 5.3.2: H = 20
    "target_update_every": 3,  # 5.3.2: C = 3
    "target_update_rate": 1.0,  # targets are copies, "only updated after C iterations"
    "gradient": "eq19",
    "likelihood": "eq11",
    "mean_weight": 0.0,  # Eq. 11 has no such term
    "trace": 1.0,  # Eq. 16 has none but the last value
    "planning": "deterministic",  # Eq. 13
    "first_value": 1,  # Eq. 18: the value terms begin at t = 1
    "reward_weights": "uniform",  # Eq. 18: each reward has the weight beta
}


@pytest.mark.parametrize("name", STATED)
def test_the_paper_preset_has_the_paper_s_number(name: str) -> None:
    assert getattr(agent_config("mbdpg", "paper"), name) == STATED[name]


def test_sequences_have_the_paper_s_length() -> None:
    config = agent_config("mbdpg", "paper")
    assert isinstance(config, mbdpg.Config)
    assert config.burn_in + config.fit_length == 200  # 5.1: sequences of length 200


def test_runs_and_episodes_have_the_paper_s_length() -> None:
    schedule, options = run_settings("paper")
    assert schedule.steps == 200_000  # Fig. 4, 5
    assert options.max_episode_steps == 1000  # 5.1, in training and test


def test_beta_falls_as_the_return_rises() -> None:
    config = agent_config("mbdpg", "paper")
    assert isinstance(config, mbdpg.Config)
    assert config.beta > config.final_beta == 0  # 4.3.2: "avoid short-sightedness ... by updating beta"


def test_networks_have_the_paper_s_three_layers() -> None:
    agent = mbdpg.MBDPG(mbdpg.Config(width=4, memory=4), EnvSpec("Probe-v0", 2, 1, None, None))
    state = jax.eval_shape(lambda: agent.init(key=jax.random.key(0)))
    assert len(state.actor.mlp.hidden) == len(state.dynamics.trunk.hidden) == 3
    assert jax.tree.structure(state.target_critics) == jax.tree.structure(state.critics)


def test_the_default_preset_is_the_configs_own_defaults() -> None:
    assert agent_config("mbdpg", "default") == mbdpg.Config()
    assert agent_config("td3", "default") == td3.Config() and agent_config("sac", "default") == sac.Config()
    schedule, options = run_settings("default")
    assert schedule == Schedule() and options == RunConfig("Pendulum-v1").env_options


def test_a_task_of_its_own_settings_keeps_all_others() -> None:
    own = agent_config("mbdpg", "default", "LunarLanderContinuous-v3")
    returns = {"grounding_length": 32, "grounding_batch_size": 16, "grounding_tolerance": 0.6}
    real = mbdpg.Config(horizon=0, actor_value="mean", **returns)
    assert own == real == agent_config("mbdpg", "default", "LunarLanderContinuous-v2")
    assert agent_config("mbdpg", "default", "BipedalWalker-v3") == mbdpg.Config(grounding_tolerance=1000.0)
    assert agent_config("mbdpg", "default", "Pendulum-v1") == mbdpg.Config()
    recent = {"recent_steps": 10_000, "recent_terminations": 20}
    hopper = mbdpg.Config(planning="stochastic", discount=0.995, actor_value="mean", huber_delta=1.0, **recent)
    assert agent_config("mbdpg", "default", "Hopper-v5") == hopper
    cheetah = mbdpg.Config(planning="stochastic", discount=0.98)
    assert agent_config("mbdpg", "default", "HalfCheetah-v4") == cheetah
    assert agent_config("mbdpg", "default", "Ant-v5") == dataclasses.replace(cheetah, exploration_std=0.1)
    assert agent_config("mbdpg", "paper", "LunarLanderContinuous-v3") == agent_config("mbdpg", "paper")
    assert agent_config("td3", "default", "LunarLanderContinuous-v3") == td3.Config()


@pytest.mark.parametrize(
    ("preset", "algorithm", "env"),
    [(preset, name, env) for preset, own in TASKS.items() for name, tasks in own.items() for env in tasks],
)
def test_a_task_s_settings_are_of_registered_tasks_of_all_versions_and_differ_from_the_others(
    preset: str, algorithm: str, env: str
) -> None:
    ids = [known for known in gymnasium.registry if known.rpartition("-v")[0] == env]
    assert ids
    for name, value in TASKS[preset][algorithm][env].items():
        assert getattr(agent_config(algorithm, preset), name) != value
        assert {getattr(agent_config(algorithm, preset, known), name) for known in ids} == {value}


def test_the_rivals_have_their_authors_sizes_and_settings() -> None:
    # Haarnoja et al. 2018b, Table 1, and Fujimoto et al. 2018; random steps as in the last code of both.
    shared = {"layers": 2, "width": 256, "plain": True, "batch_size": 256, "learning_rate": 3e-4, "discount": 0.99}
    shared |= {"target_update_rate": 0.005, "updates_per_step": 1, "exploration_scatter": 0, "exploration_color": 0}
    own = {
        "td3": {
            "exploration_std": 0.1,
            "target_noise": 0.2,
            "target_noise_clip": 0.5,
            "policy_delay": 2,
            "random_steps": 25_000,
        }
    }
    soft = {"entropy_per_action": -1, "initial_temperature": 1}
    own |= {"sac": soft | {"random_steps": 10_000}}
    # Janner et al. 2019, Appendix C, and as in their code.
    own |= {
        "mbpo": soft
        | {"random_steps": 5000, "updates_per_step": 20, "rollouts_per_step": 400, "imagine_every": 250}
        | {"retained_steps": 1000, "real_share": 0.05, "members": 7, "elites": 5, "dynamics_width": 200}
        | {"dynamics_learning_rate": 1e-3, "fit_batch_size": 256, "rollout_length": 1, "final_rollout_length": 1}
    }
    for algorithm in ("td3", "sac", "mbpo"):
        config = agent_config(algorithm, "paper")
        expected = shared | own[algorithm]
        assert {name: getattr(config, name) for name in expected} == expected


def test_pets_has_its_authors_settings() -> None:
    # Chua et al. 2018 and kchua/handful-of-trials, HalfCheetah.
    expected = {"horizon": 30, "population": 500, "plan_elites": 50, "iterations": 5, "smoothing": 0.1, "members": 5}
    expected |= {"dynamics_width": 200, "dynamics_learning_rate": 1e-3, "random_steps": 1000, "termination": "learned"}
    config = agent_config("pets", "paper", "HalfCheetah-v5")
    assert {name: getattr(config, name) for name in expected} == expected
    assert config.particles * config.members == 20


@pytest.mark.parametrize(
    ("env", "updates", "length", "until", "entropy"),
    [
        ("Hopper-v5", 20, 15, 150_000, -1),
        ("HalfCheetah-v5", 40, 1, 150_000, -3),
        ("Walker2d-v5", 20, 1, 150_000, -3),
        ("Ant-v5", 20, 25, 100_000, -4),
    ],
)
def test_mbpo_has_its_authors_settings_for_each_task(
    env: str, updates: int, length: int, until: int, entropy: float
) -> None:
    # jannerm/mbpo, examples/config.
    config, actions = agent_config("mbpo", "paper", env), gymnasium.make(env).action_space.shape
    assert (config.updates_per_step, config.final_rollout_length, config.lengthen_until) == (updates, length, until)
    assert actions is not None and config.entropy_per_action * actions[0] == pytest.approx(entropy)
    assert config.termination == "known" and config.lengthen_from == 20_000
    cheap = agent_config("mbpo", "default", env)
    assert (cheap.final_rollout_length, cheap.entropy_per_action) == (length, config.entropy_per_action)
    assert cheap.termination == "learned"


@pytest.mark.parametrize("algorithm", CONFIGS)
def test_a_preset_names_nothing_that_the_config_does_not_have(algorithm: str) -> None:
    assert PAPER[algorithm].keys() <= {field.name for field in dataclasses.fields(CONFIGS[algorithm])}


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(UserError, match="unknown --algorithm 'ppo'; expected one of mbdpg, td3, sac, pets, mbpo"):
        agent_config("ppo", "default")
    with pytest.raises(UserError, match="unknown --preset 'big'; expected default or paper"):
        agent_config("mbdpg", "big")
