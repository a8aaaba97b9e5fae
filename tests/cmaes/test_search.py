"""Whole searches: optima inside and on bounds, failures, ties, reasons for stopping, determinism, resuming."""

import math
from dataclasses import replace

import numpy as np
import pytest
from mjx_cmaes import Reason, Settings, ask, init, inject, load_state, minimize, restart, save_state, should_stop, tell

OPTIMUM = np.array([0.3, 0.8, 0.55, 0.21, 0.67])


def sphere(points: np.ndarray) -> np.ndarray:
    return ((points - OPTIMUM[: points.shape[1]]) ** 2).sum(axis=1)


def run(function, dimension=5, generations=20, seed=0, std=0.2, **choices):
    settings = Settings(dimension, **choices)
    state = init(settings, np.full(dimension, 0.5), std, seed=seed)
    infos = []
    for _ in range(generations):
        points, state = ask(settings, state)
        assert points.min() >= 0
        assert points.max() <= 1
        state, info = tell(settings, state, points, function(points))
        infos.append(info)
    return settings, state, infos


def assert_healthy(state):
    for name in ("mean", "scale", "covariance", "basis", "axes", "path_sigma", "path_full", "path_diagonal"):
        assert np.isfinite(getattr(state, name)).all(), name
    assert 0 < state.sigma < math.inf
    assert (state.std > 0).all()


@pytest.mark.parametrize("dimension", [1, 2, 5])
@pytest.mark.parametrize("population", [5, 20, 128])
def test_sphere_inside(dimension, population):
    result = minimize(sphere, np.full(dimension, 0.5), 0.2, settings=Settings(dimension, population), iterations=150)
    np.testing.assert_allclose(result.best_x, OPTIMUM[:dimension], atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_optimum_on_bounds(seed):
    target = np.array([0.0, 1.0, 0.4, 0.0, 0.6, 1.0])
    rotation = np.linalg.qr(np.random.default_rng(seed).standard_normal((6, 6)))[0]
    weights = 10.0 ** np.arange(6)

    def cost(points):
        return ((points - target) @ rotation) ** 2 @ weights

    start = np.array([0.7, 0.2, 0.9, 0.5, 0.1, 0.3])
    result = minimize(cost, start, 1 / 6, iterations=100, seed=seed)
    np.testing.assert_allclose(result.best_x, target, atol=1e-3)
    assert result.best_cost < 1e-5


def test_optimum_in_a_corner_is_hit_exactly():
    # The cost falls towards the corner without a minimum there: the bound alone makes the optimum.
    result = minimize(lambda x: x @ np.array([1.0, -2.0, 0.5]), np.full(3, 0.4), 0.1, iterations=60)
    assert result.best_x.tolist() == [0.0, 1.0, 0.0]
    assert_healthy(result.state)


def test_collapse_on_a_corner_stays_finite():
    _, state, _ = run(lambda x: x.sum(axis=1), 3, generations=400)
    assert_healthy(state)
    assert state.best_cost == 0


def test_per_coordinate_std():
    settings = Settings(2, 1000)
    state = init(settings, np.array([0.5, 0.5]), np.array([0.1, 0.001]))
    np.testing.assert_allclose(ask(settings, state)[0].std(axis=0), [0.1, 0.001], rtol=0.1)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_failures_rank_last(bad, share):
    generator = np.random.default_rng(1)

    def cost(points):
        return np.where(generator.random(len(points)) < share, bad, sphere(points))

    _, state, infos = run(cost, generations=60)
    assert_healthy(state)
    assert infos[0].finite < 128
    assert state.best_cost < 1e-2


def test_half_the_box_fails():
    def cost(points):
        return np.where(points[:, 0] > 0.45, math.nan, sphere(points))

    result = minimize(cost, np.full(5, 0.5), 0.2, iterations=60)
    assert result.best_cost < 1e-8


def test_all_fail_only_shrinks():
    settings, state, infos = run(lambda x: np.full(len(x), math.nan), generations=10)
    assert_healthy(state)
    np.testing.assert_array_equal(state.mean, np.full(5, 0.5))
    assert infos[-1].sigma < infos[0].sigma
    assert state.best_cost == math.inf
    assert should_stop(settings, state) is Reason.FAILED


def test_all_fail_returns_the_start():
    start = np.full(5, 0.25)
    result = minimize(lambda x: np.full(len(x), math.nan), start, 0.1)
    np.testing.assert_array_equal(result.best_x, start)
    assert result.reason is Reason.FAILED


def test_all_tied_widens_and_stops():
    settings, state, infos = run(lambda x: np.full(len(x), 2.0), generations=10, std=0.01)
    assert infos[-1].sigma > infos[0].sigma > 0.01
    np.testing.assert_array_equal(state.mean, np.full(5, 0.5))
    assert should_stop(settings, state) is Reason.ALL_TIED


def test_leaves_a_plateau():
    # Flat within 0.15 of the start, where the first generations lie.
    def cost(points):
        return np.maximum(np.abs(points - 0.9).max(axis=1), 0.0) * (np.abs(points - 0.5).max(axis=1) > 0.15) + (
            np.abs(points - 0.5).max(axis=1) <= 0.15
        )

    result = minimize(cost, np.full(5, 0.5), 0.01, settings=Settings(5, patience=100), iterations=100)
    np.testing.assert_allclose(result.best_x, 0.9, atol=0.05)


def test_quantised_cost():
    result = minimize(lambda x: np.floor(32 * np.abs(x - OPTIMUM)).sum(axis=1), np.full(5, 0.5), 0.2, iterations=60)
    assert result.best_cost == 0


def test_start_is_kept_where_nothing_is_better():
    start = np.array([0.1, 0.2, 0.3])
    calls = []

    def cost(points):
        calls.append(points)
        return (points != start).any(axis=1).astype(float)

    result = minimize(cost, start, 0.1, iterations=3)
    assert (calls[0] == start).all(axis=1).any()
    np.testing.assert_array_equal(result.best_x, start)
    assert result.best_cost == 0
    assert result.evaluations == 3 * 128


def test_start_equal_to_others_is_preferred():
    start = np.full(2, 0.5)
    result = minimize(lambda x: np.ones(len(x)), start, 0.1, iterations=5)
    np.testing.assert_array_equal(result.best_x, start)


def test_given_points_are_evaluated():
    given = OPTIMUM[None]
    result = minimize(sphere, np.full(5, 0.5), 0.05, given=given, iterations=1)
    np.testing.assert_array_equal(result.best_x, OPTIMUM)
    assert result.history[0].injected == 2


def test_best_never_rises_and_history_is_consistent():
    result = minimize(sphere, np.full(5, 0.5), 0.2, iterations=30)
    best = [info.best_cost for info in result.history]
    assert best == sorted(best, reverse=True)
    assert [info.generation for info in result.history] == list(range(1, 31))
    assert result.history[-1].evaluations == 30 * 128


@pytest.mark.parametrize(
    ("choices", "function", "reason"),
    [
        ({"target": 1e-3}, sphere, Reason.TARGET),
        ({"max_evaluations": 256}, sphere, Reason.BUDGET),
        ({"tolerance_x": 1e-3, "tolerance_cost": 0.0}, sphere, Reason.TOLERANCE_X),
        ({"tolerance_cost": 1e-6}, sphere, Reason.TOLERANCE_COST),
        ({"condition_limit": 1.5}, lambda x: (x.sum(axis=1) - 2) ** 2, Reason.ILL_CONDITIONED),
    ],
)
def test_reasons(choices, function, reason):
    result = minimize(function, np.full(5, 0.5), 0.2, settings=Settings(5, **choices), iterations=300)
    assert result.reason is reason
    assert str(reason).endswith(".")


def test_callback_can_stop():
    result = minimize(sphere, np.full(5, 0.5), 0.2, callback=lambda state, info: info.generation == 4)
    assert len(result.history) == 4


@pytest.mark.parametrize("where", ["best", "uniform"])
@pytest.mark.parametrize("growth", [1.0, 2.0])
def test_restarts_leave_a_local_optimum(where, growth):
    # A wide trap at 0.2 and a narrow, deeper optimum at 0.9.
    def cost(points):
        trap = ((points - 0.2) ** 2).sum(axis=1) + 0.1
        return np.minimum(trap, 5 * ((points - 0.9) ** 2).sum(axis=1))

    settings = Settings(2, 8, restart_at=where, population_growth=growth)
    sizes = []

    def counted(points):
        sizes.append(len(points))
        return cost(points)

    start = np.full(2, 0.25)
    single = minimize(cost, start, 0.02, settings=settings, iterations=400)
    assert single.best_cost == pytest.approx(0.1, abs=1e-6)
    result = minimize(counted, start, 0.3, settings=settings, iterations=1000, restarts=10)
    assert result.state.restarts >= 1
    assert result.best_cost <= single.best_cost + 1e-9
    assert (max(sizes) > 8) == (growth > 1)
    assert result.evaluations == sum(sizes)
    if where == "uniform":
        assert result.best_cost < 1e-6


def test_restart_keeps_the_best():
    settings, state, _ = run(sphere)
    new = restart(settings, state)
    assert (new.best_cost, new.evaluations) == (state.best_cost, state.evaluations)
    np.testing.assert_array_equal(new.mean, state.best_x)
    np.testing.assert_allclose(new.std, 0.1)


def test_same_seed_same_search():
    first, second, other = (run(sphere, seed=seed)[1] for seed in (7, 7, 8))
    np.testing.assert_array_equal(first.mean, second.mean)
    assert (first.mean != other.mean).any()


def test_functions_do_not_change_their_arguments():
    settings = Settings(5)
    state = init(settings, np.full(5, 0.5), 0.2)
    before = save_state(state)
    points, asked = ask(settings, state)
    after_ask, kept = save_state(asked), points.copy()
    tell(settings, asked, points, sphere(points))
    for left, right in ((before, save_state(state)), (after_ask, save_state(asked))):
        for name in left:
            np.testing.assert_array_equal(left[name], right[name])
    np.testing.assert_array_equal(points, kept)


@pytest.mark.parametrize("restarts", [0, 3])
def test_resumed_run_is_identical(tmp_path, restarts):
    settings = Settings(5, 16, tolerance_x=1e-3, population_growth=2.0)
    start = np.full(5, 0.5)
    path = tmp_path / "state.npz"
    cut = 45

    def callback(state, info):
        if info.generation == cut:
            np.savez(path, **save_state(state))
        return None

    whole = minimize(sphere, start, 0.2, settings=settings, iterations=90, restarts=restarts, seed=3, callback=callback)
    if restarts == 0:
        cut = 20
        minimize(sphere, start, 0.2, settings=settings, iterations=90, seed=3, callback=callback)
    with np.load(path, allow_pickle=False) as arrays:
        state = load_state(settings, arrays)
    rest = minimize(sphere, start, settings=settings, iterations=90, restarts=restarts, state=state)
    assert rest.evaluations == whole.evaluations
    assert rest.reason is whole.reason
    assert rest.history == whole.history[cut:]
    expected, got = save_state(whole.state), save_state(rest.state)
    for name in expected:
        np.testing.assert_array_equal(expected[name], got[name], err_msg=name)


def test_resuming_a_finished_run_evaluates_nothing():
    whole = minimize(sphere, np.full(5, 0.5), 0.2, iterations=4)
    again = minimize(sphere, np.full(5, 0.5), iterations=4, state=whole.state)
    assert (again.evaluations, again.history, again.reason) == (whole.evaluations, (), Reason.BUDGET)
    assert again.best_cost == whole.best_cost


def test_resumed_between_ask_and_tell(tmp_path):
    settings = Settings(3, 9)
    points, state = ask(settings, init(settings, np.full(3, 0.5), 0.2))
    loaded = load_state(settings, save_state(state))
    first, info = tell(settings, state, points, sphere(points))
    second, _ = tell(settings, loaded, points, sphere(points))
    assert info.injected == 0
    np.testing.assert_array_equal(first.mean, second.mean)
    assert first.sigma == second.sigma


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Settings(0), "dimension = 0; expected a whole number >= 1"),
        (lambda: Settings(2, population=3), "population = 3; expected a whole number >= 4"),
        (lambda: Settings(2, tolerance_x=-1.0), "tolerance_x = -1.0; expected"),
        (lambda: Settings(2, restart_at="here"), "restart_at = 'here'; expected"),
        (lambda: Settings(2, target=math.nan), "target = nan; expected"),
        (lambda: Settings(2, max_evaluations=0), "max_evaluations = 0; expected"),
        (lambda: Settings(2, population_growth=0.5), "population_growth = 0.5; expected"),
        (lambda: init(Settings(2), np.zeros(3), 0.1), r"mean.shape = \(3,\); expected \(2,\)"),
        (lambda: init(Settings(2), np.array([0.5, 1.5]), 0.1), "mean = '1.5 at index 1'; expected every coordinate"),
        (lambda: init(Settings(2), np.array([0.5, math.nan]), 0.1), "mean = 'nan at index 1'; expected finite"),
        (lambda: init(Settings(2), np.zeros(2), 0.0), "std = '0 at index 0'; expected"),
        (lambda: init(Settings(2), np.zeros(2), np.ones(3)), r"std.shape = \(3,\); expected \(2,\)"),
        (lambda: init(Settings(2), np.zeros(2)), "exactly one"),
        (lambda: init(Settings(2), np.zeros(2), 0.1, np.eye(2)), "exactly one"),
        (lambda: init(Settings(2), np.zeros(2), covariance=np.eye(3)), r"covariance.shape = \(3, 3\)"),
        (lambda: init(Settings(2), np.zeros(2), covariance=np.array([[1, 2], [0, 1]])), "symmetric"),
        (lambda: init(Settings(2), np.zeros(2), covariance=np.diag([1.0, -1.0])), "positive definite"),
        (lambda: init(Settings(2), np.zeros(2), 0.1, seed=-1), "seed = -1; expected"),
        (lambda: minimize(sphere, np.zeros(2), 0.1, iterations=0), "iterations = 0; expected"),
        (lambda: minimize(sphere, np.zeros(2), 0.1, given=np.zeros((1, 3))), r"given.shape = \(1, 3\)"),
        (lambda: inject(np.zeros((4, 2)), np.zeros((5, 2))), r"given.shape = \(5, 2\)"),
    ],
)
def test_wrong_arguments(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_tell_checks_shapes_and_box():
    settings = Settings(2, 8)
    points, state = ask(settings, init(settings, np.full(2, 0.5), 0.1))
    with pytest.raises(ValueError, match=r"costs.shape = \(7,\); expected \(8,\)"):
        tell(settings, state, points, np.zeros(7))
    with pytest.raises(ValueError, match=r"points.shape = \(8, 3\)"):
        tell(settings, state, np.zeros((8, 3)), np.zeros(8))
    with pytest.raises(ValueError, match=r"every coordinate in \[0, 1\]"):
        tell(settings, state, points + 1, np.zeros(8))


def test_load_checks():
    settings = Settings(2, 8)
    arrays = save_state(init(settings, np.full(2, 0.5), 0.1))
    with pytest.raises(ValueError, match="sigma"):
        load_state(settings, {name: array for name, array in arrays.items() if name != "sigma"})
    with pytest.raises(ValueError, match=r"mean.shape = \(2,\); expected \(3,\)"):
        load_state(Settings(3, 8), arrays)
    with pytest.raises(ValueError, match="version"):
        load_state(settings, arrays | {"version": np.asarray(99)})


def test_state_is_frozen():
    state = init(Settings(2), np.full(2, 0.5), 0.1)
    with pytest.raises(AttributeError):
        state.sigma = 2.0  # type: ignore[misc]
    assert replace(state, sigma=2.0).sigma == 2.0
