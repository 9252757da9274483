"""Planning: the cross-entropy method where the optimum is known, imagined returns, and planners as files."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mbdpg.dynamics.ensemble import Ensemble, Units, predict
from mbdpg.dynamics.planning import (
    Planner,
    PlanningPolicy,
    cross_entropy,
    is_planner,
    planner_arrays,
    planner_of,
)
from mbdpg.networks.normalizer import Normalizer

O, A, MEMBERS, HORIZON = 2, 1, 2, 3


def planner(rule: str | None = None, **settings: float) -> Planner:
    ensemble = Ensemble(O, A, count=MEMBERS, widths=(8, 8), key=jax.random.key(0))
    rng = np.random.default_rng(0)
    ensemble = jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.2, x.shape), jnp.float32), ensemble)
    one = jnp.ones(())
    units = Units(Normalizer(jnp.asarray([0.5, -1.0]), jnp.asarray([2.0, 0.5])), jnp.asarray([0.2, 0.4]), one, 5 * one)
    numbers = {"horizon": HORIZON, "particles": 2, "population": 20, "plan_elites": 4, "iterations": 3}
    return Planner(
        ensemble=ensemble, units=units, rule=rule, **(numbers | {"smoothing": 0.1, "discount": 0.9} | settings)
    )


# A point with position and speed is to be brought to rest at 0: x' = A x + B u, cost x' Q x + r u^2.
STEPS = 12
DYNAMICS, INPUT, COST, EFFORT = np.array([[1.0, 0.3], [0.0, 1.0]]), np.array([0.0, 0.3]), np.diag([1.0, 0.2]), 0.1


def optimal_plan(start: np.ndarray) -> np.ndarray:
    """By Riccati's recursion."""
    value, gains = COST, []
    for _ in range(STEPS):
        gain = (INPUT @ value @ DYNAMICS) / (EFFORT + INPUT @ value @ INPUT)
        value = COST + DYNAMICS.T @ value @ (DYNAMICS - np.outer(INPUT, gain))
        gains.append(gain)
    plan, state = [], start
    for gain in reversed(gains):
        plan.append(-gain @ state)
        state = DYNAMICS @ state + INPUT * plan[-1]
    return np.array(plan)


def cost(start: np.ndarray, plans: jax.Array) -> jax.Array:
    """Of each plan, whose effort is counted with every step and its place after it."""
    d, i, c = (jnp.asarray(x, jnp.float32) for x in (DYNAMICS, INPUT, COST))

    def one(plan: jax.Array) -> jax.Array:
        def step(state: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
            after = d @ state + i * action[0]
            return after, after @ c @ after + EFFORT * action[0] ** 2

        return jnp.sum(jax.lax.scan(step, jnp.asarray(start, jnp.float32), plan)[1])

    return jax.vmap(one)(plans)


@pytest.mark.parametrize("start", [(0.4, 0.0), (-0.4, 0.1)])
def test_the_cross_entropy_method_finds_the_optimum_of_a_linear_quadratic_problem(start: tuple[float, float]) -> None:
    place = np.asarray(start)
    best = optimal_plan(place)
    assert 0.3 < np.max(np.abs(best)) < 1  # no bound is in the way
    found = cross_entropy(
        lambda plans: -cost(place, plans),
        jnp.zeros((STEPS, 1)),
        population=500,
        elites=50,
        iterations=20,
        smoothing=0.1,
        key=jax.random.key(0),
    )
    least, reached = (float(cost(place, jnp.asarray(x, jnp.float32).reshape(1, STEPS, 1))[0]) for x in (best, found))
    assert least <= reached < 1.01 * least
    assert float(found[0, 0]) == pytest.approx(best[0], abs=0.05)


class KnownWorld(Planner):
    """Plans in the linear-quadratic problem itself."""

    def imagined_return(self, observation: jax.Array, plans: jax.Array, *, key: jax.Array) -> jax.Array:
        return -cost(observation, plans)


def test_a_policy_that_plans_anew_at_every_step_is_as_good_as_the_optimal_controller() -> None:
    def cost_of(control: Callable[[np.ndarray], np.ndarray]) -> float:
        state, total = np.asarray([0.4, 0.0]), 0.0
        for _ in range(15):
            action = float(control(state).item())
            state = DYNAMICS @ state + INPUT * action
            total += float(state @ COST @ state) + EFFORT * action**2
        return total

    settings = {"horizon": STEPS, "population": 200, "plan_elites": 20, "iterations": 12}
    policy = PlanningPolicy(KnownWorld(**vars(planner(**settings))))
    assert cost_of(policy) < 1.02 * cost_of(lambda state: optimal_plan(state)[:1])


def test_plans_that_are_the_same_earn_the_same_whatever_the_noise() -> None:
    # Particles of the second plan with luck of their own made it look better or worse than the first.
    wide = jnp.full((MEMBERS, O + 1), 2.0)
    loud = eqx.tree_at(
        lambda x: (x.ensemble.members.max_log_variance, x.ensemble.members.min_log_variance), planner(), (wide, wide)
    )
    plans = jnp.full((5, HORIZON, A), 0.3)
    found = [np.asarray(loud.imagined_return(jnp.zeros(O), plans, key=jax.random.key(seed))) for seed in (0, 1)]
    np.testing.assert_allclose(found[0], found[0][0], rtol=1e-5)
    assert abs(found[0][0] - found[1][0]) > 0.01


def test_plans_stay_within_the_bounds() -> None:
    found = cross_entropy(
        lambda plans: jnp.sum(plans, axis=(1, 2)),
        jnp.zeros((4, 2)),
        population=100,
        elites=10,
        iterations=30,
        smoothing=0.0,
        key=jax.random.key(0),
    )
    assert (found > 0.5).all() and (found <= 1.0).all()  # the variance goes with the room that is left


@pytest.mark.parametrize("rule", [None, "Ant"])
def test_an_imagined_return_is_the_mean_of_a_python_loops(rule: str | None) -> None:
    one = planner(rule)
    # Without noise, so that the loop need not draw the same.
    narrow = jnp.full((MEMBERS, O + 1), -30.0)
    one = eqx.tree_at(
        lambda x: (x.ensemble.members.max_log_variance, x.ensemble.members.min_log_variance), one, (narrow, narrow)
    )
    rng = np.random.default_rng(1)
    plans, start = rng.uniform(-1, 1, (4, HORIZON, A)).astype(np.float32), np.float32([0.5, 0.3])
    found = one.imagined_return(jnp.asarray(start), jnp.asarray(plans), key=jax.random.key(0))
    for plan, value in zip(plans, found, strict=True):
        total = 0.0
        for member in range(MEMBERS):
            state, alive, ensemble = start, 1.0, one.ensemble.chosen(jnp.asarray([member]))
            for t, action in enumerate(plan):
                step = predict(ensemble, one.units, jnp.asarray(state)[None, None], jnp.asarray(action)[None, None])
                state = np.asarray(step.next_observation[0, 0])
                goes_on = float(0.2 <= state[0] <= 1.0) if rule else float(step.continues[0, 0])
                reward = goes_on * float(step.reward[0, 0]) + (1 - goes_on) * float(step.terminal_reward[0, 0])
                total += 0.9**t * alive * reward / MEMBERS
                alive *= goes_on
        assert float(value) == pytest.approx(total, rel=1e-3, abs=1e-4)


def test_what_runs_away_is_never_chosen() -> None:
    mad = planner()
    mad = eqx.tree_at(lambda x: x.ensemble.members.output.bias, mad, jnp.full((MEMBERS, 2 * O + 4), jnp.inf))
    plans = jnp.zeros((3, HORIZON, A))
    assert (mad.imagined_return(jnp.zeros(O), plans, key=jax.random.key(0)) == -jnp.inf).all()


def test_noise_of_the_model_is_imagined_and_its_mean_taken_over_particles() -> None:
    wide = jnp.full((MEMBERS, O + 1), 2.0)
    loud = eqx.tree_at(
        lambda x: (x.ensemble.members.max_log_variance, x.ensemble.members.min_log_variance), planner(), (wide, wide)
    )

    def returns(particles: int) -> np.ndarray:
        one = Planner(**(vars(loud) | {"particles": particles}))
        keys = jax.random.split(jax.random.key(0), 300)
        plans = jnp.zeros((1, HORIZON, A))
        return np.asarray(jax.vmap(lambda k: one.imagined_return(jnp.zeros(O), plans, key=k)[0])(keys))

    few, many = returns(1), returns(16)
    assert few.std() > 0.3
    assert many.std() == pytest.approx(few.std() / 4, rel=0.25)
    assert many.mean() == pytest.approx(few.mean(), abs=4 * few.std() / np.sqrt(300))


def test_a_policy_begins_from_the_rest_of_its_last_plan_until_it_is_reset() -> None:
    one, key, observation = planner(), jax.random.key(3), np.float32([0.3, -0.7])
    acting, before = PlanningPolicy(one, key=key), np.zeros((HORIZON, A), np.float32)
    for step in range(4):
        if step == 3:
            acting.reset()
            before = np.zeros((HORIZON, A), np.float32)
        assert acting.memory == [step, *before.ravel().tolist()]
        plan = one.plan(jnp.asarray(observation), jnp.asarray(before), key=jax.random.fold_in(key, step))
        np.testing.assert_allclose(acting(observation), plan[0], atol=1e-6)
        before = np.asarray(acting.memory[1:], np.float32).reshape(HORIZON, A)
        np.testing.assert_allclose(before, [*plan[1:], *np.zeros((1, A))], atol=1e-6)


def test_a_policy_goes_on_from_another_s_memory() -> None:
    observation = np.float32([0.3, -0.7])
    one, other = PlanningPolicy(planner()), PlanningPolicy(planner())
    one(observation)
    other.memory = one.memory
    np.testing.assert_array_equal(one(observation), other(observation))
    assert one.memory == other.memory and one.memory[0] == 2


def test_actions_are_within_bounds_and_of_the_right_observation() -> None:
    acting, observation = PlanningPolicy(planner()), np.float32([0.3, -0.7])
    action = acting(observation)
    assert action.shape == (A,) and action.dtype == np.float32 and np.abs(action).max() <= 1
    assert acting.explore(observation, np.float32([5.0])) == 1.0
    with pytest.raises(ValueError, match=r"observations of shape \(2,\), not \(3,\)"):
        acting(np.zeros(3, np.float32))


@pytest.mark.parametrize("rule", [None, "Hopper"])
def test_a_planner_comes_back_from_its_arrays(rule: str | None) -> None:
    one = planner(rule)
    arrays = planner_arrays(one)
    assert is_planner(arrays) and not is_planner({"mean": np.zeros(1)})
    back = planner_of(arrays)
    assert jax.tree.structure(back) == jax.tree.structure(one)
    for found, expected in zip(jax.tree.leaves(back), jax.tree.leaves(one), strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"planner/horizon": np.asarray(0)}, "impossible settings"),
        ({"planner/horizon": np.asarray(True)}, "impossible settings"),
        ({"planner/horizon": np.asarray(10**9)}, "too long"),
        ({"planner/particles": np.asarray(10**9)}, "too long"),
        ({"planner/smoothing": np.asarray(np.nan)}, "impossible settings"),
        ({"planner/smoothing": np.asarray(0.1j)}, "impossible settings"),
        ({"planner/discount": np.asarray(-1.0)}, "impossible settings"),
        ({"units/normalizer/std": np.zeros(2, np.float32)}, "std is not positive"),
        ({"planner/horizon": np.asarray(2.5)}, "impossible settings"),
        ({"planner/plan_elites": np.asarray(21)}, "impossible settings"),
        ({"planner/rule": np.frombuffer(b"Quake", np.uint8)}, "impossible settings"),
        ({"planner/horizon": np.zeros(2)}, "not whole"),
        ({"ensemble/members/hidden/0/weight": np.zeros((2, 3), np.float32)}, "not whole"),
        ({"ensemble/members/hidden/1/bias": np.zeros((2, 3), np.float32)}, "hidden/1/bias is not float32"),
        ({"units/delta": np.float32([1, np.nan])}, "units/delta is not float32"),
        ({"units/reward": None}, "units/reward is not float32"),
        ({"planner/smoothing": None}, "not whole"),
    ],
)
def test_a_stranger_s_planner_that_cannot_be_is_refused(change: dict[str, np.ndarray | None], said: str) -> None:
    arrays = {name: value for name, value in (planner_arrays(planner()) | change).items() if value is not None}
    with pytest.raises(ValueError, match=said):
        planner_of(arrays)
