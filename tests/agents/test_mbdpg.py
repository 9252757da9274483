"""What each update of MBDPG moves, what it must not, and what it does with odd data."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mbdpg.agents.mbdpg import MBDPG, Config, State
from mbdpg.dynamics.fitting import Window, warm_memory
from mbdpg.dynamics.imagination import Ring, imagine
from mbdpg.interfaces import Batch, EnvSpec, Statistics
from mbdpg.networks.critic import Critics
from mbdpg.training.replay import Replay

O, A, BATCH, BURN_IN, LENGTH = 3, 2, 4, 2, 3
ENV = EnvSpec("made-in-code", observation_size=O, action_size=A, episode_limit=None, reference_return=None)
NETWORKS = {"width": 8, "memory": 8, "gaussians": 2}
SHAPES = {"batch_size": BATCH, "fit_batch_size": BATCH, "burn_in": BURN_IN, "fit_length": LENGTH, "horizon": 2}
PAPER = {
    "gradient": "eq19",
    "likelihood": "eq11",
    "reward_weights": "uniform",
    "first_value": 1,
    "trace": 0.95,
    "imagination_ratio": 0.5,
    "imagination_depth": 4,
    "target_update_every": 3,
    "target_update_rate": 0.25,
    "average_share": 0.0,
}
"""The other value of every switch."""
MODES = pytest.mark.parametrize("settings", [(), tuple(PAPER.items())], ids=["default", "paper"])


def agent(settings: tuple = ()) -> MBDPG:
    return MBDPG(Config(**(NETWORKS | SHAPES | dict(settings))), ENV)


@functools.cache
def compiled(name: str, settings: tuple) -> Callable[..., Any]:
    chosen = getattr(agent(settings), name)
    return jax.jit(lambda state, batch, key: chosen(state, batch, key=key))


def update(name: str, settings: tuple = ()) -> Callable[..., tuple[State, dict[str, Any]]]:
    """One compiled update; the agents share their states, whatever their settings."""
    return lambda state, batch, seed=0: compiled(name, settings)(state, batch, jax.random.key(seed))


@functools.cache
def fresh() -> State:
    return jax.jit(lambda key: agent().init(key=key))(jax.random.key(0))


@functools.cache
def state() -> State:
    """Networks away from their start, targets away from what they follow, scales away from 1."""
    rng = np.random.default_rng(0)

    def shaken(network):
        return jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.2, x.shape), jnp.float32), network)

    def networks(x: State):
        return tuple(getattr(x, name) for name in NETWORKS_OF_A_STATE)

    moved = eqx.tree_at(networks, fresh(), tuple(map(shaken, networks(fresh()))))
    return jax.jit(agent().prepare)(moved, statistics())


def statistics(progress: float = 0.25) -> Statistics:
    numbers = ([0.1, -0.2, 0.3], [1.0, 2.0, 0.5], [0.2, 1.0, 0.25], 0.8, 5.0, 2.0, progress, 100.0)
    return Statistics(*(jnp.asarray(x, jnp.float32) for x in numbers))


def batch(length: int, size: int = BATCH, seed: int = 0) -> Batch:
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return rng.normal(size=(size, length, *shape)).astype(np.float32)

    ones = np.ones((size, length), np.float32)
    return Batch(draw(O), np.tanh(draw(A)), draw(), draw(O), 0 * ones, ones)


BATCHES = {"fit": batch(BURN_IN + LENGTH), "clone": batch(1), "improve": batch(BURN_IN + 1), "ground": batch(4)}
TARGETS = {"target_actor", "target_critics"}
NETWORKS_OF_A_STATE = ("dynamics", "average_dynamics", "actor", "average_actor", "critics", *sorted(TARGETS))
MOVES = {
    "fit": {"dynamics", "average_dynamics", "dynamics_optimizer"},
    "improve": {"actor", "average_actor", "critics", "actor_optimizer", "critic_optimizer", "updates", *TARGETS},
}
MOVES["clone"] = MOVES["improve"]
MOVES["ground"] = {"critics", "critic_optimizer", "updates", *TARGETS}


def finite(tree: Any) -> bool:
    return all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def edited(original: Batch, **changes: tuple[Any, float]) -> Batch:
    """A copy with a number written at an index of some fields."""
    copy = jax.tree.map(np.copy, original)
    for name, (at, value) in changes.items():
        getattr(copy, name)[at] = value
    return copy


def last(window: Window) -> tuple[jax.Array, jax.Array]:
    """The observations and actions that improving learns from."""
    return window.observation[:, -1], window.action[:, -1]


@pytest.mark.parametrize("name", ["fit", "clone", "improve", "ground"])
def test_an_update_moves_its_own_networks_and_nothing_else(name: str, differences: Callable[..., set[str]]) -> None:
    after, metrics = update(name)(state(), BATCHES[name])
    assert differences(state(), after) == MOVES[name]
    assert finite(after) and finite(metrics)


def test_the_papers_settings_move_the_same_and_fill_the_imagination_buffer(
    differences: Callable[..., set[str]],
) -> None:
    settings = tuple(PAPER.items())
    after, metrics = update("fit", settings)(state(), BATCHES["fit"])
    assert differences(state(), after) == MOVES["fit"]
    assert finite(after) and finite(metrics)
    after, metrics = update("improve", settings)(state(), BATCHES["improve"])
    # The targets wait for the third update.
    expected = MOVES["improve"] - TARGETS | {"imagined"}
    assert differences(state(), after) == expected
    assert finite(after) and finite(metrics)


@pytest.mark.parametrize("name", ["dynamics", "actor", "critics"])
def test_every_parameter_is_moved_by_its_update(name: str) -> None:
    kind = "fit" if name == "dynamics" else "improve"
    ends = edited(BATCHES[kind], terminated=((0, -1), 1))
    before, after = getattr(state(), name), getattr(update(kind)(state(), ends)[0], name)
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True):
        assert (x != y).any(), jax.tree_util.keystr(path)


def test_a_fresh_state_has_targets_and_averages_equal_to_what_they_follow() -> None:
    fresh_state = fresh()
    for target in ("target_actor", "target_critics", "average_actor", "average_dynamics"):
        online = target.partition("_")[2]
        pairs = zip(*(jax.tree.leaves(getattr(fresh_state, name)) for name in (online, target)), strict=True)
        assert all(np.array_equal(x, y) for x, y in pairs)
    assert finite(update("improve")(fresh_state, BATCHES["improve"])[0])


def test_targets_follow_at_their_rate_at_every_update() -> None:
    before = state()
    after, _ = update("improve")(before, BATCHES["improve"])
    rate = agent().config.target_update_rate
    # The target actor follows the actor as it was when the critics' targets were made.
    for target, online in (("target_critics", after.critics), ("target_actor", before.actor)):
        for old, new, followed in zip(
            *map(jax.tree.leaves, (getattr(before, target), getattr(after, target), online)), strict=True
        ):
            np.testing.assert_allclose(new, (1 - rate) * old + rate * followed, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("share", "updates", "rate"), [(0.0, 999, 1.0), (1.0, 0, 1.0), (0.01, 1000, 1 / 11)])
@pytest.mark.parametrize("name", ["fit", "clone", "improve"])
def test_averages_reach_back_over_a_share_of_the_updates(name: str, share: float, updates: int, rate: float) -> None:
    counted = [
        optax.tree.set(own, count=jnp.int32(updates)) for own in (state().dynamics_optimizer, state().actor_optimizer)
    ]
    before = eqx.tree_at(lambda x: (x.dynamics_optimizer, x.actor_optimizer), state(), counted)
    after, _ = update(name, (("average_share", share),))(before, BATCHES[name])
    network = "dynamics" if name == "fit" else "actor"
    trees = (getattr(before, f"average_{network}"), getattr(after, f"average_{network}"), getattr(after, network))
    for old, new, followed in zip(*map(jax.tree.leaves, trees), strict=True):
        np.testing.assert_allclose(new, (1 - rate) * old + rate * followed, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("tolerance", [1e-3, 0.5, 1e3])
def test_real_returns_are_numpys_while_actions_are_alike_and_steps_follow(tolerance: float) -> None:
    given = edited(BATCHES["ground"], terminated=((0, 2), 1.0), valid=((0, 3), 0.0))
    given = edited(given, valid=((1, slice(2, None)), 0.0))  # cut off after two steps
    settings = (("target_noise", 0.0), ("grounding_tolerance", tolerance))
    one, s = agent(settings), state()
    _, metrics = update("ground", settings)(s, given)
    observation, after = (s.normalizer(jnp.asarray(x)) for x in (given.observation, given.next_observation))
    values = np.asarray(one._target_value(s, after, key=jax.random.key(0)))
    found = np.asarray(s.critics(observation, jnp.asarray(given.action)))
    away = np.sqrt(np.mean((given.action - np.asarray(s.actor(observation))) ** 2, axis=-1))
    rewards, total, shares = given.reward / np.asarray(s.return_scale), 0.0, []
    for i in range(BATCH):
        last = int(given.valid[i].sum()) - 1
        target = 0.0 if given.terminated[i, last] else values[i, last]
        for t in range(last, -1, -1):
            share = 1.0 if t == last else np.exp(-0.5 * (away[i, t + 1] / tolerance) ** 2)
            shares += [] if t == last else [share]
            alive = 1.0 - given.terminated[i, t]
            target = rewards[i, t] + one.config.discount * alive * ((1 - share) * values[i, t] + share * target)
            total += np.sum((found[:, i, t] - target) ** 2)
    assert float(metrics["critic/grounding_loss"]) == pytest.approx(total / given.valid.sum(), rel=1e-4)
    assert float(metrics["critic/grounding_trace"]) == pytest.approx(np.mean(shares), rel=1e-4)


def test_the_share_followed_is_a_number_where_returns_have_one_step() -> None:
    _, metrics = update("ground", ())(state(), batch(1))
    assert float(metrics["critic/grounding_trace"]) == 0.0


def test_the_averages_are_evaluated_and_imagine_and_the_newest_learn(differences: Callable[..., set[str]]) -> None:
    learned, normalizer = agent().policy(state())
    assert learned is state().average_actor and normalizer is state().normalizer
    windows, realized = jax.tree.map(jnp.asarray, batch(BURN_IN + 20)), jnp.zeros(BATCH)
    diagnose = jax.jit(lambda s: agent().diagnose(s, windows, realized))

    def outcome(changed: State) -> tuple[State, State, dict[str, jax.Array]]:
        return (
            update("fit")(changed, BATCHES["fit"])[0],
            update("improve")(changed, BATCHES["improve"])[0],
            diagnose(changed),
        )

    def replaced(name: str) -> State:
        return eqx.tree_at(lambda x: getattr(x, name), state(), getattr(fresh(), name))

    def moved(name: str) -> set[str]:
        """What depends on a network: fitted dynamics, improved actor, instruments."""
        (fit, improved, metrics), (other_fit, other_improved, other) = outcome(state()), outcome(replaced(name))
        found = {"fit"} if "dynamics" in differences(fit, other_fit) else set()
        found |= {"improve"} if "actor" in differences(improved, other_improved) else set()
        return found | {key for key in metrics if metrics[key] != other[key]}

    errors = {f"dynamics/rmse_{depth}" for depth in ("k01", "k05", "k10", "k20")}
    along = {"dynamics/reward_bias", "dynamics/survival_imagined"}
    assert moved("dynamics") == {"fit"}
    assert {"improve"} | errors | along <= moved("average_dynamics") and "fit" not in moved("average_dynamics")
    assert along <= moved("average_actor") and not ({"improve"} | errors) & moved("average_actor")
    assert not along & moved("actor")


def test_without_a_horizon_nothing_depends_on_the_model(differences: Callable[..., set[str]]) -> None:
    settings = (("horizon", 0),)
    assert [phase.name for phase in agent(settings).phases] == ["cloning", "improving", "grounding"]
    elsewhere = eqx.tree_at(
        lambda x: x.average_dynamics, state(), jax.tree.map(lambda x: x + 1.0, state().average_dynamics)
    )
    once, other = (update("improve", settings)(before, BATCHES["improve"])[0] for before in (state(), elsewhere))
    assert differences(once, other) == {"average_dynamics"}
    assert differences(state(), once) == MOVES["improve"]
    one = agent(settings)
    windows = jax.tree.map(jnp.asarray, batch(one.diagnosis.burn_in + one.diagnosis.length))
    found = jax.eval_shape(lambda s: one.diagnose(s, windows, jnp.zeros(BATCH)), state())
    assert set(found) == {"critic/q_bias", "critic/realized_return"}


def test_without_a_horizon_the_critics_target_is_td3s() -> None:
    """Eq. 14, with the value of the target actor's smoothed action."""
    one, key = agent((("horizon", 0), ("target_noise", 0.0))), jax.random.key(0)
    window = state().window(jax.tree.map(jnp.asarray, edited(BATCHES["improve"], terminated=((0, -1), 1))))
    start = one._start(state(), window, key=key)
    imagined = one._actor_loss(state().actor, state(), last(window), start, key)[1][0]
    found = one._targets(state(), window, start, imagined, key=key)
    after = window.next_observation[:, -1]
    value = np.min(state().target_critics(after, state().target_actor(after)), axis=0)
    alive = 1.0 - np.asarray(window.terminated[:, -1])
    expected = np.asarray(state().real_reward(window))[:, -1] + 0.99 * alive * value
    np.testing.assert_allclose(found, expected[None], rtol=1e-5)


@pytest.mark.parametrize("settings", [(), (("horizon", 0),), tuple(PAPER.items())], ids=["default", "0", "paper"])
def test_the_critics_gradient_is_that_of_differentiating_their_loss(settings: tuple) -> None:
    """Though it is made of what the actor's loss has found on its way."""
    one, data = agent(settings), jax.tree.map(jnp.asarray, edited(BATCHES["improve"], terminated=((0, -1), 1)))
    window, (start_key, target_key, model_key) = state().window(data), jax.random.split(jax.random.key(0), 3)
    start = one._start(state(), window, key=start_key)
    imagined = one._actor_loss(state().actor, state(), last(window), start, model_key)[1][0]
    targets = one._targets(state(), window, start, imagined, key=target_key)
    weights = imagined.survival()[:-1] * start.weight[None]

    def loss(critics: Critics) -> jax.Array:
        real = critics(*last(window))
        total = jnp.sum(jnp.mean(jnp.square(real - targets[0][None]), axis=1))
        if one.config.horizon == 0:
            return total
        along = jnp.square(critics(imagined.observations[:-1], imagined.actions[:-1]) - targets[1:][None])
        return total + one.config.imagined_weight * jnp.sum(along * weights[None]) / jnp.maximum(jnp.sum(weights), 1.0)

    value, gradient = jax.value_and_grad(loss)(state().critics)
    _, metrics = one.improve(state(), data, key=jax.random.key(0))
    np.testing.assert_allclose(metrics["critic/loss"], value, rtol=1e-4)
    np.testing.assert_allclose(metrics["critic/grad_norm"], optax.tree.norm(gradient), rtol=1e-4)


def test_without_terminal_values_the_actor_does_not_see_the_critics(differences: Callable[..., set[str]]) -> None:
    elsewhere = eqx.tree_at(lambda x: x.critics, state(), jax.tree.map(lambda x: x + 1.0, state().critics))
    for settings, matters in (((), True), ((("terminal_value", False),), False)):
        once, other = (update("improve", settings)(before, BATCHES["improve"])[0] for before in (state(), elsewhere))
        assert ("actor" in differences(once, other)) == matters


@pytest.mark.parametrize(("actor_value", "reduced"), [("clipped", np.min), ("mean", np.mean)])
def test_the_actor_climbs_the_value_that_it_is_told_to(actor_value: str, reduced: Callable[..., np.ndarray]) -> None:
    """Without a horizon J is the value of its own action, and nothing else."""
    one = agent((("horizon", 0), ("actor_value", actor_value)))
    window = state().window(jax.tree.map(jnp.asarray, BATCHES["improve"]))
    start = one._start(state(), window, key=jax.random.key(0))
    _, (_, _, metrics) = one._actor_loss(state().actor, state(), last(window), start, jax.random.key(0))
    values = state().critics(start.observation, state().actor(start.observation))
    np.testing.assert_allclose(metrics["actor/objective"], np.mean(reduced(values, axis=0)), rtol=1e-5)


@pytest.mark.parametrize(("phase", "loss"), [("improve", "critic/loss"), ("ground", "critic/grounding_loss")])
def test_large_errors_count_by_their_size_for_a_share_that_follows_the_return(phase: str, loss: str) -> None:
    """With a delta far below all errors: 1 - progress of the squares is left, and at its end what is in proportion."""
    end = eqx.tree_at(lambda x: x.progress, state(), jnp.ones(()))

    def found(before: State, delta: float) -> float:
        return float(update(phase, (("huber_delta", delta),))(before, BATCHES[phase])[1][loss])

    assert found(end, 2e-5) == pytest.approx(2 * found(end, 1e-5), rel=1e-2)
    assert found(state(), 1e-5) == pytest.approx((1 - float(state().progress)) * found(state(), 0.0), rel=1e-2)


def test_targets_wait_for_the_third_update_where_c_is_3(differences: Callable[..., set[str]]) -> None:
    step = update("improve", tuple(PAPER.items()))
    states = [state()]
    for i in range(6):
        states.append(step(states[-1], BATCHES["improve"], i)[0])
    moved = [TARGETS & differences(a, b) for a, b in itertools.pairwise(states)]
    assert moved == [set(), set(), TARGETS, set(), set(), TARGETS]
    for old, new, followed in zip(
        *map(jax.tree.leaves, (states[2].target_critics, states[3].target_critics, states[3].critics)), strict=True
    ):
        np.testing.assert_allclose(new, 0.75 * old + 0.25 * followed, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("trace", [0.0, 0.4, 1.0])
def test_the_real_step_is_the_first_of_the_expansion(trace: float) -> None:
    """TD(lambda) over the real step and then the imagined ones, by hand."""
    one = agent((("trace", trace), ("target_noise", 0.0)))
    data = jax.tree.map(jnp.asarray, edited(BATCHES["improve"], terminated=((0, -1), 1)))
    window, key = state().window(data), jax.random.key(0)
    start = one._start(state(), window, key=key)
    _, (imagined, *_) = one._actor_loss(state().actor, state(), last(window), start, key)
    found = one._targets(state(), window, start, imagined, key=key)
    value = np.asarray(one._target_value(state(), imagined.observations, key=key))
    rewards, alive = np.asarray(imagined.rewards), np.asarray(imagined.continues)
    after, along = value[-1], []
    for t in reversed(range(len(rewards))):
        after = rewards[t] + 0.99 * alive[t] * ((1 - trace) * value[t + 1] + trace * after)
        along.insert(0, after)
    real = np.asarray(state().real_reward(window))[:, -1]
    real = real + 0.99 * (1 - np.asarray(window.terminated[:, -1])) * ((1 - trace) * value[0] + trace * after)
    np.testing.assert_allclose(found[0], real, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found[1:], along, rtol=1e-4, atol=1e-5)


@MODES
@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_a_batch_that_is_not_finite_moves_nothing_and_is_counted(
    settings: tuple, poison: float, differences: Callable[..., set[str]]
) -> None:
    bad = edited(BATCHES["fit"], reward=((0, BURN_IN), poison))
    after, metrics = update("fit", settings)(state(), bad)
    assert differences(state(), after) == MOVES["fit"] - {"dynamics"}  # the average nears what is there already
    assert metrics["dynamics/skipped"] == 1
    assert optax.tree.get(after.dynamics_optimizer, "count") == 0  # so it does not count for the average either
    # Infinite observations are clipped by the normalizer: nothing to skip. NaN reaches both, a reward the critics.
    bad = edited(BATCHES["improve"], reward=((0, -1), poison), next_observation=((1, -1), np.nan))
    after, metrics = update("improve", settings)(state(), bad)
    assert not {"actor", "critics", "dynamics"} & differences(state(), after)
    assert metrics["actor/skipped"] == 1 and metrics["critic/skipped"] == 1
    assert finite((after.target_actor, after.target_critics, after.actor_optimizer, after.critic_optimizer))
    again, metrics = update("improve", settings)(after, BATCHES["improve"])
    assert {"actor", "critics"} <= differences(after, again)
    assert finite((again.actor, again.critics)) and finite(metrics)
    assert metrics["actor/skipped"] == 1 and metrics["critic/skipped"] == 1


@MODES
def test_nothing_is_imagined_after_the_end_of_an_episode(settings: tuple, differences: Callable[..., set[str]]) -> None:
    """The state in which an episode ended: neither actor nor critics may learn from it or from what would follow."""
    ended = edited(BATCHES["improve"], terminated=((0, -1), 1))
    after, metrics = update("improve", settings)(state(), ended)
    elsewhere, other = update("improve", settings)(state(), edited(ended, next_observation=((0, -1), 3.0)))
    assert differences(after, elsewhere) <= {"imagined"}
    assert metrics["actor/objective"] == other["actor/objective"]
    assert after.imagined.rows.weight[0] == 0
    alive, _ = update("improve", settings)(state(), BATCHES["improve"])
    assert {"actor", "critics"} <= differences(after, alive)


def test_a_batch_of_ends_alone_leaves_the_actors_output_as_it_is(differences: Callable[..., set[str]]) -> None:
    ended = edited(BATCHES["improve"], terminated=(slice(None), 1))
    after, metrics = update("improve")(state(), ended)
    assert metrics["actor/objective"] == 0
    assert "actor" not in differences(state(), after) and "critics" in differences(state(), after)


def test_a_time_limit_is_not_an_end(differences: Callable[..., set[str]]) -> None:
    """The last step of a truncated episode bootstraps from its next observation, that of a terminated one does not."""
    differs = {}
    for kind in ("truncated", "terminated"):
        replay = Replay(O, A)
        rng = np.random.default_rng(0)
        for step in range(BURN_IN + 1):
            last = step == BURN_IN
            observation, action, after = (rng.normal(size=n).astype(np.float32) for n in (O, A, O))
            replay.add(
                observation, np.tanh(action), 1.0, after, last and kind == "terminated", last and kind == "truncated"
            )
        windows = replay.windows(np.full(BATCH, BURN_IN), agent().phases[2].sampling)
        assert windows.valid.all()
        other = edited(windows, next_observation=((slice(None), -1), 0.3))
        outcomes = [update("improve")(state(), windows)[0] for windows in (windows, other)]
        differs[kind] = differences(*outcomes)
    assert {"actor", "critics"} <= differs["truncated"]
    assert not differs["terminated"]


def test_imagination_goes_on_from_the_buffer_up_to_its_depth() -> None:
    settings = tuple(PAPER.items())
    current, depths = state(), []
    ended = edited(BATCHES["improve"], terminated=((3, -1), 1))
    for i in range(8):
        current, _ = update("improve", settings)(current, ended, i)
        rows = slice(i * BATCH, (i + 1) * BATCH)
        depths.append(np.asarray(current.imagined.rows.depth[rows]))
        alive = np.asarray(current.imagined.rows.weight[rows] > 0)
        assert (alive == (depths[-1] <= PAPER["imagination_depth"]) & (np.arange(BATCH) != 3)).all()
    depths = np.stack(depths)
    assert (depths[0] == 2).all()  # the buffer was empty: all from real states
    assert (depths[:, 2:] == 2).all()  # the half that always starts there
    # Started from depth 2 they reach 4 and may be started from again; from 4 they reach 6, too deep to be.
    assert set(depths[:, :2].ravel()) == {2, 4, 6}
    assert int(current.imagined.added) == 8 * BATCH and finite(current.imagined)


def test_a_share_of_one_imagines_from_real_states_only_while_the_buffer_is_empty() -> None:
    one = agent((("imagination_ratio", 1.0),))
    window = state().window(jax.tree.map(jnp.asarray, BATCHES["improve"]))
    start = jax.jit(lambda s: one._start(s, window, key=jax.random.key(0)))
    np.testing.assert_array_equal(start(state()).observation, window.next_observation[:, -1])
    rows = state().imagined.rows._replace(weight=jnp.full(32, 0.5), depth=jnp.full(32, 2.0))
    full = Ring(rows, jnp.int32(32))
    started = start(eqx.tree_at(lambda x: x.imagined, state(), full))
    assert (started.depth == 2).all() and (started.weight == 0.5).all() and not started.observation.any()


def test_rewards_reach_the_critics_in_units_of_value_and_the_model_in_its_own() -> None:
    mixed = jax.tree.map(jnp.asarray, edited(BATCHES["improve"], terminated=((0, -1), 1)))
    window = state().window(mixed)
    reward = np.asarray(mixed.reward)
    np.testing.assert_allclose(state().real_reward(window), reward / 2.0, rtol=1e-5)
    np.testing.assert_allclose(window.reward[1:], reward[1:] / 0.8, rtol=1e-5)
    np.testing.assert_allclose(window.terminal_reward[0, -1], reward[0, -1] / 5.0, rtol=1e-5)
    assert window.reward[0, -1] == 0 and not window.terminal_reward[1:].any()


@pytest.mark.parametrize("progress", [0.0, 0.25, 1.0])
def test_beta_and_the_spread_of_exploration_follow_the_return(
    progress: float, differences: Callable[..., set[str]]
) -> None:
    moving = agent((("beta", 3.0),))
    prepared = jax.jit(moving.prepare)(state(), statistics(progress))
    metrics = update("improve", (("beta", 3.0),))(prepared, BATCHES["improve"])[1]
    assert float(metrics["actor/beta"]) == pytest.approx(3 - 2 * progress)
    actor, normalizer, std = moving.behavior(prepared)
    assert actor is prepared.actor and normalizer is prepared.normalizer
    assert float(std) == pytest.approx(0.3 - 0.2 * progress)
    np.testing.assert_allclose(prepared.scales.delta, [0.2, 0.5, 0.5], rtol=1e-6)
    assert {"normalizer", "scales", "return_scale", "progress"} >= differences(state(), prepared)


def test_observation_entries_that_never_change_learn_finitely() -> None:
    """As Ant's 84 unused contact forces."""
    replay, rng = Replay(O, A), np.random.default_rng(0)
    for _ in range(12):
        observation, after = (np.append(rng.normal(size=O - 1), 7.0).astype(np.float32) for _ in range(2))
        replay.add(observation, rng.uniform(-1, 1, A).astype(np.float32), 1.0, after, False, False)
    moments = jax.tree.map(jnp.asarray, replay.statistics(0.0))
    current = jax.jit(agent().prepare)(fresh(), moments)
    for name, phase in (("fit", 1), ("improve", 2)):
        windows = replay.windows(np.arange(4, 4 + BATCH), agent().phases[phase].sampling)
        current, metrics = update(name)(current, windows)
        assert finite(current) and finite(metrics)


def test_the_same_key_gives_the_same_update_and_another_key_another(differences: Callable[..., set[str]]) -> None:
    step, given = update("improve"), BATCHES["improve"]
    once, again, other = (step(state(), given, i)[0] for i in (1, 1, 2))
    assert not differences(once, again)
    assert "critics" in differences(once, other)  # noise on target actions


def test_the_instruments_are_finite_and_named_as_documented() -> None:
    sampling = agent().diagnosis
    windows = batch(sampling.burn_in + sampling.length)
    windows = edited(windows, terminated=((0, 9), 1), valid=((0, slice(10, None)), 0))
    realized = np.float32([1.0, np.nan, 2.0, np.nan])
    diagnose = jax.jit(lambda s, b, r: agent().diagnose(s, b, r))
    metrics = diagnose(state(), windows, realized)
    depths = ("k01", "k05", "k10", "k20")
    names = {f"dynamics/{name}_{depth}" for name in ("rmse", "persistence") for depth in depths}
    names |= {
        "dynamics/survival_imagined",
        "dynamics/survival_observed",
        "dynamics/out_of_range",
        "dynamics/reward_bias",
        "dynamics/return_imagined",
        "dynamics/return_observed",
    }
    names |= {"critic/q_bias", "critic/realized_return", "actor/grad_norm_k01"}
    assert set(metrics) == names
    assert all(value.shape == () for value in metrics.values()) and finite(metrics)
    assert float(metrics["dynamics/survival_observed"]) == 0.75
    assert float(metrics["critic/realized_return"]) == 1.5
    assert float(metrics["actor/grad_norm_k01"]) > 0
    richer = diagnose(state(), windows._replace(reward=windows.reward + 1), realized)
    assert float(metrics["dynamics/reward_bias"] - richer["dynamics/reward_bias"]) == pytest.approx(1.0, rel=1e-3)
    moved = state()
    value = jnp.min(
        moved.critics(
            moved.normalizer(jnp.asarray(windows.observation[:, BURN_IN])), jnp.asarray(windows.action[:, BURN_IN])
        ),
        axis=0,
    )
    assert float(metrics["critic/q_bias"]) == pytest.approx(2.0 * float(value[0] + value[2]) / 2 - 1.5, rel=1e-3)


def test_returns_of_twenty_steps_leave_out_what_a_time_limit_cuts() -> None:
    """One window whole, one ended, one cut: the cut one's rewards count in neither return."""
    one = agent((("discount", 0.9),))
    length = one.diagnosis.burn_in + one.diagnosis.length
    end, cut = BURN_IN + 4, BURN_IN + 7
    windows = edited(batch(length, 3), valid=((1, slice(end, None)), 0), terminated=((1, end - 1), 1))
    windows = edited(windows, valid=((2, slice(cut, None)), 0))
    elsewhere = edited(windows, reward=((2, cut - 1), 50.0), observation=((2, BURN_IN), 3.0), action=((2, 0), 0.9))
    found, other = (
        one.diagnose(state(), jax.tree.map(jnp.asarray, some), jnp.zeros(3)) for some in (windows, elsewhere)
    )
    powers = 0.9 ** np.arange(20)
    rewards = np.asarray(windows.reward)[:, BURN_IN:]
    expected = (rewards[0] @ powers + rewards[1, :4] @ powers[:4]) / 2
    np.testing.assert_allclose(found["dynamics/return_observed"], expected, rtol=1e-4)
    assert found["dynamics/return_observed"] == other["dynamics/return_observed"]
    assert found["dynamics/reward_bias"] != other["dynamics/reward_bias"]
    assert found["dynamics/return_imagined"] == other["dynamics/return_imagined"]
    given = state().window(jax.tree.map(jnp.asarray, windows))
    memory = warm_memory(state().average_dynamics, jax.tree.map(lambda x: x[:, :BURN_IN], given))
    imagined = imagine(
        *(state().average_dynamics, state().scales, state().average_actor, given.observation[:, BURN_IN], memory),
        horizon=20,
    )
    rewards = np.asarray(imagined.rewards * imagined.survival()[:-1] * state().return_scale)
    np.testing.assert_allclose(found["dynamics/return_imagined"], np.mean(powers @ rewards[:, :2]), rtol=1e-4)


def test_actor_and_critics_learn_from_the_newest_steps_and_falls_and_the_dynamics_from_all() -> None:
    one = agent((("recent_steps", 100), ("recent_terminations", 7)))
    recent = {phase.name: (phase.sampling.newest, phase.sampling.terminations) for phase in one.phases}
    assert recent == {"cloning": (0, 0), "fitting": (0, 0), "improving": (100, 7), "grounding": (100, 7)}
