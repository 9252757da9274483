"""Several seeds in one process: each as if alone; snapshots; and how often anything is compiled."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from mbdpg.agents import mbdpg, mbpo, pets, sac, td3
from mbdpg.dynamics.planning import Planner, PlanningPolicy
from mbdpg.interfaces import Agent, Batch, EnvSpec, UserError
from mbdpg.training import learner as learner_module
from mbdpg.training.learner import Learner
from mbdpg.training.replay import Replay

SPEC = EnvSpec("Probe-v0", observation_size=2, action_size=1, episode_limit=None, reference_return=None)
TINY = {"width": 4, "batch_size": 3}


def make_td3(**settings: Any) -> Agent:
    return td3.TD3(td3.Config(**(TINY | settings)), SPEC)


def make_sac(**settings: Any) -> Agent:
    return sac.SAC(sac.Config(**(TINY | settings)), SPEC)


def make_mbpo(**settings: Any) -> Agent:
    small = {"members": 2, "elites": 1, "dynamics_width": 4, "fit_batch_size": 3, "rollouts_per_step": 1}
    return mbpo.MBPO(mbpo.Config(**(TINY | small | {"imagine_every": 4, "retained_steps": 8} | settings)), SPEC)


def make_pets(**settings: Any) -> Agent:
    small = {"members": 2, "dynamics_width": 4, "fit_batch_size": 3, "horizon": 2, "population": 4}
    return pets.PETS(pets.Config(**(small | {"plan_elites": 2} | settings)), SPEC)


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
    return learner.diagnose(rows, [np.linspace(0, 1, 10, dtype=np.float32)] * len(seeds))


def same(left: dict[str, np.ndarray], right: dict[str, np.ndarray]) -> bool:
    return left.keys() == right.keys() and all(
        (left[k].dtype, left[k].shape, left[k].tobytes()) == (right[k].dtype, right[k].shape, right[k].tobytes())
        for k in left
    )


def same_but_for_rounding(left: dict[str, np.ndarray], right: dict[str, np.ndarray]) -> None:
    """Sums are taken in another order where seeds are computed at once, or the program is one of several devices'."""
    assert left.keys() == right.keys()
    for key in left:
        np.testing.assert_allclose(left[key], right[key], rtol=1e-4, atol=1e-5, err_msg=key)


class Two(NamedTuple):
    """Two seeds learned in one process, and the second of them alone."""

    together: Learner
    alone: Learner
    metrics: list[dict[str, np.ndarray]]
    metrics_alone: list[dict[str, np.ndarray]]


MAKERS = {"td3": make_td3, "sac": make_sac, "pets": make_pets, "mbpo": make_mbpo, "mbdpg": make_mbdpg}
# The slow ones compile as a user's program does; the quick compiler of the default tests rounds a last bit apart.
SLOW = ("td3", "sac", "mbpo", "mbdpg")
LEARNERS = ["toy", "pets", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
ONE, BOTH = jax.local_devices()[:1], jax.local_devices()[:2]


@pytest.fixture(scope="module", params=LEARNERS)
def two(request: pytest.FixtureRequest, toy: Any) -> Two:
    make = (MAKERS | {"toy": lambda: toy.ToyAgent(SPEC)})[request.param]
    together, alone = Learner(make(), [4, 9], ONE), Learner(make(), [9])
    return Two(together, alone, learn(together, [4, 9]), learn(alone, [9]))


def test_each_of_several_seeds_learns_what_it_would_learn_alone_to_the_last_bit(two: Two) -> None:
    for found, expected in zip(two.metrics, two.metrics_alone, strict=True):
        assert same({name: value[1:] for name, value in found.items()}, expected)
    assert same(two.together.snapshot(1), two.alone.snapshot(0))
    assert not same(two.together.snapshot(0), two.together.snapshot(1))
    assert same(two.together.policies()[1].arrays, two.alone.policies()[0].arrays)
    found, expected = diagnosed(two.together, [4, 9]), diagnosed(two.alone, [9])
    assert same({name: value[1:] for name, value in found.items()}, expected)


@pytest.mark.parametrize(
    "name", ["td3", *(pytest.param(name, marks=pytest.mark.slow) for name in ("sac", "pets", "mbpo", "mbdpg"))]
)
def test_all_seeds_under_one_vmap_learn_what_each_learns_alone_but_for_rounding(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = Learner(MAKERS[name](), [9])
    learn(alone, [9])
    monkeypatch.setattr(learner_module, "over_seeds", lambda function, mesh: jax.vmap(function))  # as on a GPU
    together = Learner(MAKERS[name](), [4, 9])
    learn(together, [4, 9])
    assert not same(together.snapshot(0), together.snapshot(1))
    same_but_for_rounding(together.snapshot(1), alone.snapshot(0))


@pytest.mark.parametrize(
    "name", ["td3", *(pytest.param(name, marks=pytest.mark.slow) for name in ("sac", "pets", "mbpo", "mbdpg"))]
)
def test_seeds_shared_by_two_devices_learn_what_each_learns_alone_but_for_rounding(name: str) -> None:
    alone, shared = Learner(MAKERS[name](), [9]), Learner(MAKERS[name](), [4, 9], BOTH)
    learn(alone, [9])
    learn(shared, [4, 9])
    assert all(len(leaf.sharding.device_set) == 2 for leaf in jax.tree.leaves(shared.state))
    assert all(leaf.addressable_shards[0].data.shape[0] == 1 for leaf in jax.tree.leaves(shared.state))
    assert not same(shared.snapshot(0), shared.snapshot(1))
    same_but_for_rounding(shared.snapshot(1), alone.snapshot(0))
    kept = [shared.snapshot(0), shared.snapshot(1)]
    shared.restore(kept)
    assert all(len(leaf.sharding.device_set) == 2 for leaf in jax.tree.leaves(shared.state))
    assert same(shared.snapshot(0), kept[0]) and same(shared.snapshot(1), kept[1])


@pytest.mark.gpu
@pytest.mark.parametrize("name", MAKERS)
def test_an_accelerator_learns_what_the_cpu_learns_but_for_rounding(name: str) -> None:
    learners = []
    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        learners.append(Learner(MAKERS[name](), [4, 9], [device]))
        learn(learners[-1], [4, 9])
        assert all(leaf.devices() == {device} for leaf in jax.tree.leaves(learners[-1].state))
    for seed in range(2):
        same_but_for_rounding(*(learner.snapshot(seed) for learner in learners))


@pytest.mark.parametrize(("seeds", "used"), [(1, 1), (2, 2), (3, 1), (4, 2)])
def test_seeds_are_shared_by_as_many_devices_as_get_equally_many(seeds: int, used: int) -> None:
    assert learner_module.seed_mesh(seeds, BOTH).size == used


def test_every_array_of_a_state_is_in_its_snapshot_and_comes_back(two: Two) -> None:
    leaves = jax.tree.leaves(two.together.state)
    taken = [two.together.snapshot(0), two.together.snapshot(1)]
    assert len(taken[0]) == len(leaves)
    assert [value.shape for value in taken[0].values()] == [leaf.shape[1:] for leaf in leaves]
    fresh = Learner(two.together.agent, [4, 9])
    assert not same(fresh.snapshot(0), taken[0])
    fresh.restore(taken)
    assert same(fresh.snapshot(0), taken[0]) and same(fresh.snapshot(1), taken[1])
    assert same(fresh.policies()[1].arrays, two.together.policies()[1].arrays)


def test_a_learner_goes_on_bitwise_from_a_snapshot(two: Two) -> None:
    before = two.alone.snapshot(0)
    expected = learn(two.alone, [9], range(7, 8))
    after = two.alone.snapshot(0)
    assert not same(before, after)
    two.alone.restore([before])
    for found, wanted in zip(learn(two.alone, [9], range(7, 8)), expected, strict=True):
        assert same(found, wanted)
    assert same(two.alone.snapshot(0), after)


@pytest.mark.parametrize("devices", [None, ONE, BOTH], ids=["default", "one device", "two devices"])
def test_a_restored_state_is_no_other_kind_of_argument_for_which_everything_is_compiled_again(
    devices: list[jax.Device] | None, toy: Any
) -> None:
    learner = Learner(toy.ToyAgent(SPEC), [4, 9, 2] if devices is None else [4, 9], devices)
    before = [(leaf.committed, leaf.sharding) for leaf in jax.tree.leaves(learner.state)]
    learner.restore([learner.snapshot(index) for index in range(len(learner.policies()))])
    assert [(leaf.committed, leaf.sharding) for leaf in jax.tree.leaves(learner.state)] == before


def test_a_snapshot_is_a_copy_that_later_updates_do_not_change(two: Two) -> None:
    taken = two.alone.snapshot(0)
    kept = {name: value.copy() for name, value in taken.items()}
    learn(two.alone, [9], range(9, 10))
    assert same(taken, kept) and not same(two.alone.snapshot(0), kept)
    two.alone.restore([kept])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda array: None, "nothing"),
        (lambda array: np.zeros((3, 2), np.float32), "float32[3, 2]"),
        (lambda array: array.astype(np.float64), "float64[3, 1]"),
    ],
    ids=["missing", "other shape", "other type"],
)
def test_a_snapshot_that_does_not_fit_is_refused_by_the_name_of_its_array(toy: Any, change: Any, said: str) -> None:
    learner = Learner(toy.ToyAgent(SPEC), [4])
    before, name = learner.snapshot(0), "actor/mlp/output/weight"
    changed = {key: value for key, value in (before | {name: change(before[name])}).items() if value is not None}
    with pytest.raises(UserError) as caught:
        learner.restore([changed])
    expected = f"the checkpoint does not fit this configuration: {name} is {said}, expected float32[3, 1]"
    assert str(caught.value) == expected
    assert same(learner.snapshot(0), before)


def test_a_snapshot_of_another_width_is_refused_by_the_first_key_that_differs() -> None:
    narrow, wide = Learner(make_td3(), [4]), Learner(make_td3(width=8), [4])
    # The first that differs, in the order of the state's own fields.
    with pytest.raises(UserError) as caught:
        wide.restore([narrow.snapshot(0)])
    first = next(name for name in wide.snapshot(0) if wide.snapshot(0)[name].shape != narrow.snapshot(0)[name].shape)
    assert f": {first} is float32[2, 4], expected float32[2, 8]" in str(caught.value)


def test_networks_larger_than_the_memory_are_refused_before_xla_aborts() -> None:
    with pytest.raises(MemoryError, match="GiB"):
        Learner(make_td3(width=1_000_000), [0])


def test_policies_on_the_host_are_the_state_s(two: Two) -> None:
    policies, stds = two.together.behaviors()
    observation = np.array([0.3, -0.7], np.float32)
    one = jax.tree.map(lambda x: x[1], two.together.state)
    chosen = (policies, two.together.agent.behavior(one)), (two.together.policies(), two.together.agent.policy(one))
    for found, (policy, normalizer, *_) in chosen:
        if isinstance(policy, Planner):
            assert np.abs(found[1](observation)).max() <= 1 and isinstance(found[1], PlanningPolicy)
            continue
        expected = getattr(policy, "center", policy)(normalizer(jax.numpy.asarray(observation)))
        np.testing.assert_allclose(found[1](observation), expected, atol=1e-6)
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


@pytest.mark.parametrize(
    ("name", "devices"),
    [("toy", ONE), ("toy", BOTH), *(pytest.param(name, ONE, marks=pytest.mark.slow) for name in MAKERS)],
    ids=lambda value: value if isinstance(value, str) else f"{len(value)} devices",
)
def test_nothing_is_compiled_after_the_first_round(
    name: str, devices: list[jax.Device], toy: Any, compilations: list[str]
) -> None:
    learner = Learner((MAKERS | {"toy": lambda: toy.ToyAgent(SPEC)})[name](), [4, 9], devices)
    learn(learner, [4, 9], range(1))
    diagnosed(learner, [4, 9])
    learner.behaviors()
    learner.snapshot(0)
    assert compilations
    compilations.clear()
    learn(learner, [4, 9], range(1, 6))
    diagnosed(learner, [4, 9])
    learner.behaviors()
    learner.snapshot(1)
    assert compilations == []


@pytest.mark.parametrize("devices", [ONE, BOTH], ids=["one device", "two devices"])
def test_an_update_writes_the_new_state_where_the_old_one_was(devices: list[jax.Device], toy: Any) -> None:
    learner, phase = Learner(toy.ToyAgent(SPEC), [4, 9], devices), toy.ToyAgent(SPEC).phases[0]
    before = jax.tree_util.tree_leaves_with_path(learner.state)
    batches = [experience(seed).sample(2, phase.sampling, np.random.default_rng(0)) for seed in (4, 9)]
    learner.update(learner.agent.phases[0], batches, 0)
    assert [path for path, leaf in before if not leaf.is_deleted()] == []


def test_metrics_are_means_over_the_steps_of_a_call(toy: Any) -> None:
    def losses(seed: int, counts: list[int]) -> list[float]:
        learner, found = Learner(toy.ToyAgent(SPEC), [seed]), []
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
    learner = Learner(toy.ToyAgent(SPEC), [4, 9])
    drawn = []
    for phase in learner.agent.phases:
        for done in range(5):
            rows = experience(0).sample(1, phase.sampling, np.random.default_rng(0))
            silent = rows._replace(reward=np.zeros_like(rows.reward))
            drawn.append(learner.update(phase, [silent, silent], done)["critic/loss"])
    assert len(np.unique(np.concatenate(drawn))) == 20
