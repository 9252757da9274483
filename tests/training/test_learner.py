"""Several seeds in one process: each as if alone; snapshots; and how often anything is compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
import pytest

from mbdpg.agents import mbdpg, td3
from mbdpg.interfaces import Agent, Batch, EnvSpec, Statistics, UserError
from mbdpg.networks.policy import NumpyPolicy
from mbdpg.training.learner import Learner
from mbdpg.training.replay import Replay

SPEC = EnvSpec("Probe-v0", observation_size=2, action_size=1, episode_limit=None, reference_return=None)
TINY = {"width": 4, "batch_size": 3}


def make_td3(**settings: Any) -> Agent:
    return td3.TD3(td3.Config(**(TINY | settings)), SPEC)


def make_mbdpg(**settings: Any) -> Agent:
    small = {"memory": 4, "gaussians": 2, "horizon": 2, "burn_in": 1, "fit_length": 2, "fit_batch_size": 3}
    return mbdpg.MBDPG(mbdpg.Config(**(TINY | small | settings)), SPEC)


def experience(seed: int) -> Replay:
    replay, chance = Replay(2, 1), np.random.default_rng(seed)
    for step in range(60):
        draw = chance.normal(size=5).astype(np.float32)
        replay.add(draw[:2], np.tanh(draw[2:3]), float(draw[4]), draw[:2] + 0.1, step % 15 == 14, step % 20 == 19)
    replay.demonstrated = 15
    return replay


def learn(learner: Learner, seeds: list[int], rounds: range = range(2)) -> list[dict[str, np.ndarray]]:
    """Take updates of every phase; return the metrics of each call."""
    replays, metrics = [experience(seed) for seed in seeds], []
    learner.prepare([replay.statistics(0.2) for replay in replays])
    for count in rounds:
        for phase in learner.agent.phases:
            draws = [
                replay.sample(2, phase.sampling, np.random.default_rng([seed, count]))
                for seed, replay in zip(seeds, replays, strict=True)
            ]
            metrics.append(learner.update(phase, draws, 2 * count))
    return metrics


def diagnosed(learner: Learner, seeds: list[int]) -> dict[str, np.ndarray]:
    rows = [experience(seed).windows(np.arange(10), learner.agent.diagnosis) for seed in seeds]
    return learner.diagnose(rows, [np.linspace(0, 1, 10, dtype=np.float32)] * len(seeds), 40)


def same(left: dict[str, np.ndarray], right: dict[str, np.ndarray]) -> bool:
    return left.keys() == right.keys() and all(
        (left[k].dtype, left[k].shape, left[k].tobytes()) == (right[k].dtype, right[k].shape, right[k].tobytes())
        for k in left
    )


@pytest.fixture(scope="module", params=[make_td3, make_mbdpg], ids=["td3", "mbdpg"])
def together(request: pytest.FixtureRequest) -> tuple[Callable[[], Agent], Learner, list[dict[str, np.ndarray]]]:
    learner = Learner(request.param(), [4, 9])
    return request.param, learner, learn(learner, [4, 9])


def test_each_of_several_seeds_learns_what_it_would_learn_alone_to_the_last_bit(together: Any) -> None:
    make, learner, metrics = together
    alone = Learner(make(), [9])
    for found, expected in zip(metrics, learn(alone, [9]), strict=True):
        assert same({name: value[1:] for name, value in found.items()}, expected)
    assert same(learner.snapshot(1), alone.snapshot(0))
    assert not same(learner.snapshot(0), learner.snapshot(1))
    assert same(learner.policies()[1], alone.policies()[0])


def test_every_array_of_a_state_is_in_its_snapshot_and_comes_back(together: Any) -> None:
    make, learner, _ = together
    leaves = jax.tree.leaves(learner.state)
    taken = learner.snapshot(0)
    assert len(taken) == len(leaves)
    assert {value.shape for value in taken.values()} == {leaf.shape[1:] for leaf in leaves}
    fresh = Learner(make(), [4, 9])
    assert not same(fresh.snapshot(0), taken)
    fresh.restore([learner.snapshot(0), learner.snapshot(1)])
    assert same(fresh.snapshot(0), taken) and same(fresh.snapshot(1), learner.snapshot(1))


def test_a_restored_learner_goes_on_bitwise(together: Any) -> None:
    make, _, _ = together
    whole = Learner(make(), [9])
    learn(whole, [9], range(1))
    taken = whole.snapshot(0)
    fresh = Learner(make(), [9])
    fresh.restore([taken])
    for found, expected in zip(learn(fresh, [9], range(1, 2)), learn(whole, [9], range(1, 2)), strict=True):
        assert same(found, expected)
    assert same(fresh.snapshot(0), whole.snapshot(0))


def test_a_snapshot_is_a_copy_that_later_updates_do_not_change() -> None:
    learner = Learner(make_td3(), [4])
    taken = learner.snapshot(0)
    kept = {name: value.copy() for name, value in taken.items()}
    learn(learner, [4])
    assert same(taken, kept) and not same(learner.snapshot(0), kept)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x: {k: v for k, v in x.items() if k != "critics/mlp/output/bias"}, "is nothing, expected float32"),
        (lambda x: x | {"actor/mlp/output/weight": np.zeros((4, 2), np.float32)}, r"is float32\[4, 2\], expected float32\[4, 1\]"),
        (lambda x: x | {"updates": x["updates"].astype(np.int32)}, r"updates is int32\[\], expected float32\[\]"),
    ],
    ids=["missing", "other shape", "other type"],
)  # fmt: skip
def test_a_snapshot_that_does_not_fit_is_refused_by_the_name_of_its_first_array(change: Any, said: str) -> None:
    learner = Learner(make_td3(), [4])
    before = learner.snapshot(0)
    changed = change(before)
    if changed.keys() == before.keys() - {"critics/mlp/output/bias"}:
        pytest.fail("name an array that exists")
    with pytest.raises(UserError, match=f"the checkpoint does not fit this configuration: .*{said}") as caught:
        learner.restore([changed])
    assert "\n" not in str(caught.value)
    assert same(learner.snapshot(0), before)


def test_a_snapshot_of_another_width_is_refused_by_the_first_key_that_differs() -> None:
    narrow, wide = Learner(make_td3(), [4]), Learner(make_td3(width=8), [4])
    with pytest.raises(UserError) as caught:
        wide.restore([narrow.snapshot(0)])
    first = next(name for name in wide.snapshot(0) if wide.snapshot(0)[name].shape != narrow.snapshot(0)[name].shape)
    assert f": {first} is float32[2, 4], expected float32[2, 8]" in str(caught.value)


def test_the_policy_for_acting_is_the_state_s(together: Any) -> None:
    _, learner, _ = together
    policies, stds = learner.actors()
    observation = np.array([0.3, -0.7], np.float32)
    actor, normalizer = learner.agent.policy(jax.tree.map(lambda x: x[1], learner.state))
    assert isinstance(policies[1], NumpyPolicy)
    np.testing.assert_allclose(policies[1](observation), actor(normalizer(observation)), atol=1e-6)
    assert stds.shape == (2,) and (stds >= 0).all()


@pytest.fixture
def compilations() -> Iterator[list[str]]:
    """What XLA compiles during a test."""
    names: list[str] = []

    def note(event: str, duration: float, **facts: Any) -> None:
        if event.endswith("backend_compile_duration"):
            names.append(str(facts.get("fun_name", event)))

    jax.monitoring.register_event_duration_secs_listener(note)
    yield names
    jax.monitoring.unregister_event_duration_listener(note)


def test_nothing_is_compiled_after_the_first_round(toy: Any, compilations: list[str]) -> None:
    learner = Learner(toy.agent(SPEC), [4, 9])
    learn(learner, [4, 9], range(1))
    diagnosed(learner, [4, 9])
    learner.actors()
    learner.snapshot(0)
    assert compilations
    compilations.clear()
    learn(learner, [4, 9], range(1, 6))
    diagnosed(learner, [4, 9])
    learner.actors()
    learner.snapshot(1)
    assert compilations == []


def test_metrics_are_means_over_the_steps_of_a_call(toy: Any) -> None:
    def losses(seed: int, counts: list[int]) -> list[float]:
        learner, found = Learner(toy.agent(SPEC), [seed]), []
        phase = learner.agent.phases[0]
        batch: Batch = experience(seed).sample(sum(counts), phase.sampling, np.random.default_rng(0))
        done = 0
        for count in counts:
            part = Batch(*(array[done : done + count] for array in batch))
            found.append(float(learner.update(phase, [part], done)["critic/loss"][0]))
            done += count
        return found

    np.testing.assert_allclose(losses(4, [4]), np.mean(losses(4, [1, 1, 1, 1])), rtol=1e-5)
    np.testing.assert_allclose(losses(4, [1, 3])[0], losses(4, [1, 1])[0], rtol=1e-6)


def test_a_key_is_never_used_twice(toy: Any) -> None:
    class Zero(Batch):
        pass

    learner = Learner(toy.agent(SPEC), [4, 9])
    nothing = Statistics(
        *(np.zeros(2, np.float32), np.ones(2, np.float32), np.ones(2, np.float32)), *[np.float32(1)] * 4
    )
    learner.prepare([nothing, nothing])
    drawn = []
    for phase in learner.agent.phases:
        for done in range(5):
            rows = experience(0).sample(1, phase.sampling, np.random.default_rng(0))
            silent = rows._replace(reward=np.zeros_like(rows.reward))
            drawn.append(learner.update(phase, [silent, silent], done)["critic/loss"])
    assert len(np.unique(np.concatenate(drawn))) == 20
