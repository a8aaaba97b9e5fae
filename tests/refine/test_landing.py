"""Least squares on clips that our own simulator made, without noise."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from own_clip import SCENES, SIZE, OwnClip, perturbed

from mjx_refine.batch import SceneBatch
from mjx_refine.search.features import DIRECTIONS, flow_points, outlines
from mjx_refine.search.landing import LeastSquares
from mjx_refine.search.schedule import Stage, stages
from mjx_refine.space import Space
from mjx_refine.view.outline import directions

FRAMES = 16


@pytest.fixture(scope="module", params=SCENES, ids=SCENES)
def clip(request) -> OwnClip:
    return OwnClip(SCENES[request.param], FRAMES)


@pytest.mark.parametrize(("seed", "with_flow"), [(1, False), (2, False), (2, True)])
def test_a_rough_start_lands_on_the_clip(clip, seed, with_flow):
    start = perturbed(clip.scene, seed)
    squares = clip.squares(start, flow=flow_points(clip.masks, clip.flow, (1,)) if with_flow else None)
    landing = squares.run(squares.space.start, stages(FRAMES))
    assert clip.iou(start) < 0.6
    assert clip.iou(squares.space.scene_at(landing.point)) >= 0.97
    dimension = squares.space.dimension
    assert landing.covariance.shape == (dimension, dimension)
    np.testing.assert_allclose(landing.covariance, landing.covariance.T, rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(landing.covariance).min() > 0
    # What the clip says can only narrow the prior.
    assert (np.sqrt(np.diag(landing.covariance)) <= squares.space.sigma * (1 + 1e-9)).all()
    assert landing.sensitivity.shape == (dimension,)
    assert ((landing.point >= 0) & (landing.point <= 1)).all()


def test_the_truth_stays_where_it_is(clip):
    squares = clip.squares(clip.scene)
    landing = squares.run(squares.space.start, [Stage(FRAMES, 2.0, 8)])
    assert clip.iou(squares.space.scene_at(landing.point)) > 0.98
    assert (np.abs(landing.point - squares.space.start) < squares.space.sigma).all()


def test_cost_falls_within_a_stage(clip):
    squares = clip.squares(perturbed(clip.scene, 3))
    costs = []
    point = squares.space.start
    for _ in range(4):
        stage = Stage(5, 6.0, 1)
        costs.append(float(squares.residuals(point[None], 5, 6.0)[1][0]))
        point = squares.run(point, [stage]).point
    costs.append(float(squares.residuals(point[None], 5, 6.0)[1][0]))
    assert all(later <= earlier for earlier, later in itertools.pairwise(costs))
    assert costs[-1] < 0.5 * costs[0]


def test_the_same_seed_lands_at_the_same_point(clip):
    start = perturbed(clip.scene, 4)
    one, other = (clip.squares(start, seed=5) for _ in range(2))
    first, second = (s.run(s.space.start, stages(FRAMES)[:5]) for s in (one, other))
    np.testing.assert_array_equal(first.point, second.point)
    np.testing.assert_array_equal(first.covariance, second.covariance)
    assert first.evaluations == second.evaluations


@pytest.mark.parametrize("limit", [0, 1, 60, 150, 400, 1000])
def test_the_limit_of_rollouts_is_kept_and_counted(clip, limit):
    squares = clip.squares(perturbed(clip.scene, 6), limit=limit)
    clip.rollouts = 0.0
    landing = squares.run(squares.space.start, stages(FRAMES), hops=2)
    assert landing.evaluations == pytest.approx(clip.rollouts, abs=1)
    assert landing.evaluations <= limit
    assert np.isfinite(landing.point).all()
    assert np.isfinite(landing.covariance).all()


def test_jacobian_is_the_slope_of_the_residuals(clip):
    squares = clip.squares(perturbed(clip.scene, 7, 0.3))
    space = squares.space
    base, _ = squares.residuals(space.start[None], 6, 6.0)
    jacobian = squares.jacobian(space.start, base[0], 6, 6.0)
    assert jacobian.shape == (6 * DIRECTIONS, space.dimension)
    # A step along a direction in which nothing touches anything new: the camera's pitch.
    j = space.names.index("camera.pitch")
    moved, _ = squares.residuals((space.start + 0.02 * space.sigma * np.eye(space.dimension)[j])[None], 6, 6.0)
    np.testing.assert_allclose((moved - base)[0] / 0.02, jacobian[:, j], rtol=0.05, atol=0.02 * np.abs(jacobian).max())


def test_jacobian_at_the_upper_bound_looks_inwards(clip):
    squares = clip.squares(clip.scene)
    top = np.where(np.array(squares.space.names) == "camera.pitch", 1.0, squares.space.start)
    base, _ = squares.residuals(top[None], 3, 6.0)
    assert np.isfinite(squares.jacobian(top, base[0], 3, 6.0)).all()


def test_an_unmatched_object_says_nothing(clip):
    squares = clip.squares(perturbed(clip.scene, 8), columns=(-1,))
    residuals, _ = squares.residuals(squares.space.start[None], FRAMES, 6.0)
    assert not residuals.any()
    landing = squares.run(squares.space.start, stages(FRAMES))
    np.testing.assert_allclose(landing.point, squares.space.start, atol=1e-12)
    assert not landing.sensitivity.any()
    np.testing.assert_allclose(landing.covariance, np.diag(squares.space.sigma**2), rtol=1e-9, atol=1e-15)


def test_outlines_that_cannot_be_known_say_nothing(clip):
    seen = dataclasses.replace(clip.seen, support=np.full_like(clip.seen.support, np.nan))
    squares = LeastSquares(Space.around(clip.scene), clip.rollout, seen, (0,), SIZE)
    landing = squares.run(squares.space.start, stages(FRAMES))
    np.testing.assert_array_equal(landing.point, squares.space.start)


def test_candidates_that_diverge_cost_everything(clip):
    def broken(batch: SceneBatch, frames: int) -> np.ndarray:
        poses = clip.simulator.rollout(batch, frames)
        poses[1:, -1] = np.nan
        return poses

    squares = LeastSquares(Space.around(clip.scene), broken, clip.seen, (0,), SIZE)
    _, costs = squares.residuals(np.repeat(squares.space.start[None], 3, 0), 4, 6.0)
    assert np.isfinite(costs[0])
    assert np.isinf(costs[1:]).all()
    landing = squares.run(squares.space.start, stages(FRAMES)[:2])
    assert np.isfinite(landing.point).all()


@pytest.mark.parametrize("length", [2, 3, 5, 30, 100])
def test_stages_reach_the_whole_clip(length):
    schedule = stages(length)
    assert schedule[0].frames == 1
    assert [s.frames for s in schedule] == sorted(s.frames for s in schedule)
    assert schedule[-1].frames == schedule[-2].frames == length


@pytest.mark.parametrize("radius", [8.0, 20.0, 45.0])
@pytest.mark.parametrize("shape", ["disc", "rectangle"])
def test_reach_of_masks_is_unbiased_in_every_direction(shape, radius):
    generator = np.random.default_rng(7)
    normals = directions(DIRECTIONS)
    rows, columns = np.mgrid[0:160, 0:160] + 0.5
    errors = []
    for _ in range(60):
        centre, turn = 80 + generator.uniform(0, 1, 2), generator.uniform(0, np.pi)
        u = (columns - centre[0]) * np.cos(turn) + (rows - centre[1]) * np.sin(turn)
        v = (rows - centre[1]) * np.cos(turn) - (columns - centre[0]) * np.sin(turn)
        if shape == "disc":
            inside, true = u**2 + v**2 < radius**2, normals @ centre + radius
        else:
            inside = (np.abs(u) < radius) & (np.abs(v) < radius / 2)
            along = normals @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            true = normals @ centre + np.abs(along) @ [radius, radius / 2]
        errors.append(outlines(inside[None].astype(np.int32)).support[0, 0] - true)
    bias = np.mean(errors, 0)
    assert abs(bias.mean()) < 0.08
    assert np.abs(bias).max() < 0.25
