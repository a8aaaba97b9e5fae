"""Solvers from optax and jaxopt on problems with known answers, and on clips that our own simulator made."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from own_clip import SCENES, OwnClip, perturbed
from scipy.optimize import lsq_linear

from mjx_refine.cli import commands
from mjx_refine.errors import InputError
from mjx_refine.scene import Scene
from mjx_refine.search.landing import Landing, LeastSquares
from mjx_refine.search.options import SOLVERS, Options
from mjx_refine.search.schedule import Stage, stages
from mjx_refine.search.solvers import STEPS, StageProblem, improve

OTHERS = tuple(STEPS)
FRAMES = 12

every_solver = pytest.mark.parametrize("solver", OTHERS)


class Clip(OwnClip):
    """A clip of a scene, a start some prior widths away, and least squares from there."""

    def __init__(self, scene: Scene):
        super().__init__(scene, FRAMES)
        self.start = perturbed(scene, 2)

    def land(self, solver: str, schedule: list[Stage] | None = None, **options) -> tuple[LeastSquares, Landing]:
        self.rollouts = 0.0
        squares = self.squares(self.start, solver=solver, **options)
        schedule = stages(FRAMES) if schedule is None else schedule
        return squares, squares.run(squares.space.start, schedule, hops=1)


@pytest.fixture(scope="module", params=SCENES, ids=SCENES)
def clip(request) -> Clip:
    return Clip(SCENES[request.param])


@every_solver
def test_a_rough_start_lands_on_the_clip(clip, solver):
    squares, landing = clip.land(solver)
    assert clip.iou(clip.start) < 0.5
    assert clip.iou(squares.space.scene_at(landing.point)) >= (0.94 if solver == "adam" else 0.97)
    assert ((landing.point >= 0) & (landing.point <= 1)).all()
    assert np.linalg.eigvalsh(landing.covariance).min() > 0
    assert (np.sqrt(np.diag(landing.covariance)) <= squares.space.sigma * (1 + 1e-9)).all()
    assert landing.evaluations == pytest.approx(clip.rollouts, abs=1)


@every_solver
def test_the_same_seed_lands_at_the_same_point(clip, solver):
    first, second = (clip.land(solver, stages(FRAMES)[:4], seed=3)[1] for _ in range(2))
    np.testing.assert_array_equal(first.point, second.point)
    np.testing.assert_array_equal(first.covariance, second.covariance)
    assert first.evaluations == second.evaluations


@every_solver
@pytest.mark.parametrize("limit", [0, 60, 300])
def test_the_limit_of_rollouts_is_kept_and_counted(clip, solver, limit):
    _, landing = clip.land(solver, limit=limit)
    assert landing.evaluations == pytest.approx(clip.rollouts, abs=1)
    assert landing.evaluations <= limit
    assert np.isfinite(landing.point).all()
    assert np.isfinite(landing.covariance).all()


@every_solver
def test_cost_is_that_of_the_point_and_below_the_start(clip, solver):
    stage = Stage(5, 6.0, 3)
    squares, landing = clip.land(solver, [stage])
    space = squares.space
    costs = squares.residuals(np.stack([space.start, landing.point]), 5, 6.0)[1]
    assert landing.cost == pytest.approx(costs[1], rel=1e-9)
    assert costs[1] < 0.5 * costs[0]


# Problems with known answers ------------------------------------------------------------------------------------------

LINEAR = np.random.default_rng(1).normal(size=(12, 5)) * [3.0, 1.0, 10.0, 2.0, 0.0]
WIDTHS = np.array([0.1, 0.2, 0.05, 0.3, 0.1])
MIDDLE = np.array([0.5, 0.4, 0.6, 0.5, 0.9])


class Linear:
    """Residuals LINEAR u - target, which counts what is asked of it."""

    def __init__(self, target: np.ndarray):
        self.target, self.points, self.jacobians = target, [], 0
        self.problem = StageProblem(self.residuals, self.jacobian, MIDDLE, WIDTHS, 20)

    def residuals(self, point: np.ndarray) -> tuple[np.ndarray, float]:
        assert ((point >= 0) & (point <= 1)).all()
        self.points.append(point.tobytes())
        u = (point - MIDDLE) / WIDTHS
        base = LINEAR @ u - self.target
        return base, 0.5 * float(base @ base + u @ u)

    def jacobian(self, point: np.ndarray, base: np.ndarray) -> np.ndarray:
        self.jacobians += 1
        return LINEAR

    def answer(self) -> np.ndarray:
        """By scipy, within the box."""
        bounds = ((0 - MIDDLE) / WIDTHS, (1 - MIDDLE) / WIDTHS)
        whole = np.concatenate([LINEAR, np.eye(5)])
        return lsq_linear(whole, np.concatenate([self.target, np.zeros(5)]), bounds, tol=1e-14).x


@pytest.mark.parametrize("far", [1.0, 20.0], ids=["inside", "at bounds"])
@every_solver
def test_linear_least_squares_agrees_with_scipy(solver, far):
    linear = Linear(far * LINEAR @ [1.0, -0.7, 0.3, 0.5, 0.0])
    answer = linear.answer()
    if far > 1:
        u = MIDDLE + WIDTHS * answer
        assert ((u < 1e-6) | (u > 1 - 1e-6)).any()
    point, cost, jacobian = improve(solver, linear.problem, MIDDLE, 30, lambda: False)
    assert ((point >= 0) & (point <= 1)).all()
    np.testing.assert_allclose((point - MIDDLE) / WIDTHS, answer, atol=0.02 if solver == "adam" else 5e-3)
    base = linear.residuals(point)[0]
    assert cost == pytest.approx(0.5 * float(base @ base + (((point - MIDDLE) / WIDTHS) ** 2).sum()))
    np.testing.assert_array_equal(jacobian, LINEAR)


@pytest.mark.parametrize("solver", ["gauss-newton", "levenberg-marquardt"])
def test_no_point_is_evaluated_twice(solver):
    linear = Linear(LINEAR @ [1.0, -0.7, 0.3, 0.5, 0.0])
    improve(solver, linear.problem, MIDDLE, 3, lambda: False)
    assert len(linear.points) == len(set(linear.points))
    assert linear.jacobians <= len(linear.points)


@every_solver
def test_at_the_answer_nothing_moves(solver):
    linear = Linear(np.zeros(12))
    point, cost, _ = improve(solver, linear.problem, MIDDLE, 5, lambda: False)
    np.testing.assert_array_equal(point, MIDDLE)
    assert cost == 0
    assert len(linear.points) == 1


@every_solver
def test_a_diverging_neighbour_is_not_taken(solver):
    linear = Linear(LINEAR @ [1.0, -0.7, 0.3, 0.5, 0.0])

    def residuals(point: np.ndarray) -> tuple[np.ndarray, float]:
        base, cost = linear.residuals(point)
        return base, cost if abs(point[0] - MIDDLE[0]) < 0.5 * WIDTHS[0] else np.inf

    problem = StageProblem(residuals, linear.jacobian, MIDDLE, WIDTHS, 20)
    point, cost, _ = improve(solver, problem, MIDDLE, 10, lambda: False)
    assert np.isfinite(cost)
    assert cost < linear.residuals(MIDDLE)[1]
    assert abs(point[0] - MIDDLE[0]) < 0.5 * WIDTHS[0]


def test_solvers_have_one_list():
    assert ("lm", *OTHERS) == SOLVERS
    assert commands.SOLVERS == SOLVERS
    with pytest.raises(InputError, match="solver = 'newton'; expected one of lm, adam"):
        Options(solver="newton")
    assert dataclasses.asdict(Options())["solver"] == "lm"
