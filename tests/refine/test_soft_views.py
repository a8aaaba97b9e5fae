"""Views that can be differentiated, against dense polygons, hard pictures and differences in double precision."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from benchmarks import raster
from mjx_refine.batch import SceneBatch, batch_from_scenes
from mjx_refine.search.features import flow_points, outlines
from mjx_refine.view.distance import signed_distance
from mjx_refine.view.moments import Moments, mask_moments, moments
from mjx_refine.view.outline import directions, support_function, supports
from mjx_refine.view.picture import draw
from mjx_refine.view.points import point_flow
from mjx_refine.view.soft import Features, residuals, soft_masks

LARGE = (480, 320)
SMALL = (96, 64)
KIND = ("box", "cylinder", "sphere")
EACH = pytest.mark.parametrize("shape", KIND)


# Scenes -----------------------------------------------------------------------------------------------------------------


def scenes(kind: tuple, count: int, seed: int, lift: float = 30.0) -> tuple[SceneBatch, np.ndarray]:
    """(batch, poses of two frames) of random scenes, ``lift`` metres higher so that no floor cuts a silhouette."""
    generator = np.random.default_rng(seed)
    batch = batch_from_scenes([raster.random_scene(kind, generator) for _ in range(count)])
    up = np.array([0.0, 0.0, lift])
    batch = dataclasses.replace(batch, position=batch.position + up, camera_position=batch.camera_position + up)
    poses = np.concatenate([batch.position, batch.quaternion], -1)[:, None].repeat(2, 1)
    poses[:, 1, :, :3] += 0.02 * generator.standard_normal((count, len(kind), 3))
    return batch, poses


def arrays_of(batch: SceneBatch, poses: np.ndarray, dtype=np.float32) -> tuple:
    fields = (poses, batch.size, batch.camera_position, batch.camera_pitch, batch.camera_fovy)
    return tuple(jnp.asarray(a, dtype) for a in fields)


def in_front(batch: SceneBatch, poses: np.ndarray, least: float = 0.05) -> np.ndarray:
    """Whether all of every object's bounding sphere is ahead of the camera, (batch,)."""
    relative = poses[..., :3] - batch.camera_position[:, None, None]
    pitch = batch.camera_pitch[:, None, None]
    depth = relative[..., 1] * np.sin(pitch) - relative[..., 2] * np.cos(pitch)
    return (depth - np.linalg.norm(batch.size, axis=-1)[:, None] > least).all((1, 2))


def pixel_grid(size: tuple[int, int]) -> np.ndarray:
    y, x = np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], -1)


# A second implementation in float64 --------------------------------------------------------------------------------------


def dense_points(shape: str, size: np.ndarray, centre: np.ndarray, turn: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Points of the world that span the silhouette: corners, rims of 4096, or the circle that touches the view cone."""
    angle = 2 * np.pi * np.arange(4096) / 4096
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    if shape == "sphere":
        away = centre - camera
        distance = np.linalg.norm(away)
        frame = np.linalg.svd(away[None] / distance)[2]
        ratio = size[0] / distance
        return centre - away / distance * size[0] * ratio + size[0] * np.sqrt(1 - ratio**2) * circle[:, :2] @ frame[1:]
    if shape == "box":
        local = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    else:
        local = np.concatenate([size[0] * circle + sign * np.array([0, 0, size[1]]) for sign in (-1, 1)])
    return local @ raster.rotation(turn).T + centre


def dense_picture(
    kind: tuple, batch: SceneBatch, pose: np.ndarray, row: int, image: tuple[int, int]
) -> list[np.ndarray]:
    """Those points in the picture [px], for each object."""
    pitch, camera = batch.camera_pitch[row], batch.camera_position[row]
    c, s = np.cos(pitch), np.sin(pitch)
    to_world = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    focal = image[1] / 2 / np.tan(batch.camera_fovy[row] / 2)
    result = []
    for n, shape in enumerate(kind):
        seen = (dense_points(shape, batch.size[row, n], pose[n, :3], pose[n, 3:], camera) - camera) @ to_world
        flat = focal * seen[:, :2] / -seen[:, 2:] * [1, -1]
        result.append(flat + np.array(image) / 2)
    return result


# Outlines ---------------------------------------------------------------------------------------------------------------


def test_supports_are_those_of_dense_polygons():
    batch, poses = scenes(KIND, 120, 0, 0.0)
    chosen = np.nonzero(in_front(batch, poses))[0]
    assert len(chosen) > 60
    reach = supports(poses, batch, LARGE, 48)
    for row in chosen:
        for n, points in enumerate(dense_picture(KIND, batch, poses[row, 0], row, LARGE)):
            np.testing.assert_allclose(reach[row, 0, n], (points @ directions(48).T).max(0), atol=1e-3, rtol=0)


@EACH
def test_supports_in_double_precision(shape):
    batch, poses = scenes((shape,), 40, 1, 0.0)
    with jax.enable_x64(True):
        reach = np.asarray(
            jax.jit(lambda a: support_function((shape,), a, 48, LARGE))(arrays_of(batch, poses, np.float64))
        )
    for row in np.nonzero(in_front(batch, poses))[0]:
        (points,) = dense_picture((shape,), batch, poses[row, 0], row, LARGE)
        # The polygon lies inside, by at most 1 - cos(pi / 4096) of its extent.
        gap = reach[row, 0, 0] - (points @ directions(48).T).max(0)
        assert gap.min() > -1e-9 * np.abs(points).max()
        assert gap.max() < 1e-6 * np.ptp(points, axis=0).max()


# Derivatives ------------------------------------------------------------------------------------------------------------


def seen_features(count: int, frames: int, seed: int) -> Features:
    """Features that no scene has, with some unknown."""
    generator = np.random.default_rng(seed)

    def of(*shape: int) -> np.ndarray:
        return generator.uniform(20, 300, (frames, count, *shape))

    reach, flow, area = of(16), of(7, 2) / 50, of() ** 2
    reach[:, :, 3], flow[:, :, 2], area[0, 0] = np.nan, np.nan, np.nan
    second = of(1, 1) * np.eye(2)
    second[0, 0] = np.nan
    flow[-1] = np.nan
    return Features(reach, Moments(area, of(2), second), of(7, 2), flow)


def views(kind: tuple, image: tuple[int, int], width: float = 3.0) -> dict:
    """Views as functions of arrays to (batch, features); residuals hold supports, moments and flow."""
    generator = np.random.default_rng(3)
    pixels = generator.uniform(-20, np.array(image) + 20, (40, 2))
    seen = seen_features(len(kind), 2, 4)

    def flat(grid: jnp.ndarray) -> jnp.ndarray:
        return grid.reshape(len(grid), -1)

    return {
        "distance": lambda a: flat(signed_distance(kind, a, jnp.asarray(pixels, a[0].dtype), image, 32)),
        "masks": lambda a: flat(soft_masks(kind, a, jnp.asarray(pixels, a[0].dtype), image, width, 32)),
        "residuals": lambda a: residuals(kind, a, seen, image).flat(),
    }


@pytest.mark.parametrize("name", ["distance", "masks", "residuals"])
def test_derivatives_equal_differences_in_double_precision(name):
    batch, poses = scenes(KIND, 60, 7, 0.3)
    chosen = np.nonzero(in_front(batch, poses))[0][:24]
    batch, poses = batch[chosen], poses[chosen]
    generator = np.random.default_rng(11)
    step = 1e-6
    with jax.enable_x64(True):
        arrays = arrays_of(batch, poses, np.float64)
        view = jax.jit(views(KIND, LARGE)[name])
        push = jax.jit(lambda a, t: jax.jvp(views(KIND, LARGE)[name], (a,), (t,))[1])
        pull = jax.jit(lambda a, w: jax.vjp(views(KIND, LARGE)[name], a)[1](w)[0])
        good = total = 0
        for _ in range(4):
            tangent = tuple(jnp.asarray(generator.standard_normal(a.shape)) for a in arrays)
            middle = view(arrays)
            ends = [view(tuple(a + s * step * t for a, t in zip(arrays, tangent, strict=True))) for s in (-1, 1)]
            difference = np.asarray(ends[1] - ends[0]) / (2 * step)
            forward = np.asarray(push(arrays, tangent))
            # At a corner, such as from one vertex to the next, a derivative lies between the one-sided differences.
            bend = np.abs(np.asarray(ends[1] + ends[0] - 2 * middle)) / step
            scale = 1.0 + np.abs(difference)
            good, total = good + (bend < 1e-3 * scale).sum(), total + bend.size
            assert (np.abs(forward - difference) < 0.5 * bend + 1e-4 * scale).all()
            # Reverse mode is the transpose of forward mode.
            weight = jnp.asarray(generator.standard_normal(middle.shape))
            back = sum((g * t).sum() for g, t in zip(pull(arrays, weight), tangent, strict=True))
            assert float(back) == pytest.approx(float((weight * forward).sum()), rel=1e-8)
        assert good > 0.97 * total


def awkward(kind: tuple, count: int) -> tuple[SceneBatch, np.ndarray]:
    """Random scenes, most of them made awkward in one way."""
    batch, poses = scenes(kind, 40, 21, 0.0)
    rows = np.arange(count) % len(poses)
    batch, poses = batch[rows].map(np.copy), poses[rows].copy()
    generator = np.random.default_rng(5)
    turn = generator.standard_normal((count, 1, len(kind), 4))
    poses[..., 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    camera = batch.camera_position[:, None, None]
    ahead = np.stack([0 * batch.camera_pitch, np.sin(batch.camera_pitch), -np.cos(batch.camera_pitch)], -1)[
        :, None, None
    ]
    way = np.arange(count) % 12
    pick = [way == k for k in range(12)]
    poses[pick[0], :, :, :3] = (camera - 3 * ahead)[pick[0]]  # Behind.
    poses[pick[1], :, :, :3] = camera[pick[1]]  # Around the camera.
    poses[pick[2], :, :, :3] = (camera + batch.size[:, None, :, :1] * ahead)[pick[2]]  # Touching it.
    poses[pick[3], :, :, 0] += 40.0  # Far outside.
    poses[pick[4], :, :, :3] = (camera + 3 * ahead)[pick[4]]  # All in one place, on the axis.
    poses[pick[5], :, :, 3:] = [1.0, 0.0, 0.0, 0.0]  # Faces edge on: on the axis of a camera that looks straight down.
    poses[pick[5], :, :, :3] = (camera - np.array([0, 0, 2.0]))[pick[5]]
    batch.camera_pitch[pick[5]] = 0.0
    batch.size[pick[6]] = 0.0
    batch.size[pick[7]] = 1e-4
    poses[pick[8], 1] = poses[pick[8], 0]  # Not moving.
    poses[pick[9], :, :, 2] = -1e3  # What stands in for a diverged candidate.
    poses[pick[10], :, :, 2] = -0.2  # Below the floor.
    poses[pick[11], 1, :, :3] = (camera[:, 0] - ahead[:, 0])[pick[11]]  # Flies past the camera.
    return batch, poses


@pytest.mark.parametrize("name", ["masks", "residuals"])
def test_nothing_is_nan_in_a_thousand_awkward_scenes(name):
    batch, poses = awkward(KIND, 1008)
    view = views(KIND, LARGE, 0.5)[name]

    def both(arrays):
        values, pull = jax.vjp(view, arrays)
        return (
            values,
            pull(jnp.ones_like(values))[0],
            jax.jvp(view, (arrays,), (jax.tree.map(jnp.ones_like, arrays),))[1],
        )

    result = jax.jit(both)(arrays_of(batch, poses))
    for part in jax.tree.leaves(result):
        bad = np.logical_not(np.isfinite(np.asarray(part)).reshape(len(poses), -1).all(-1))
        assert not bad.any(), sorted({int(k) for k in np.nonzero(bad)[0] % 12})


# Distances and masks ------------------------------------------------------------------------------------------------------


def distance_to_polygon(points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Signed distance to the convex hull of ``points``, by its edges."""
    hull = points[ConvexHull(points).vertices]
    edge = np.roll(hull, -1, 0) - hull
    relative = pixels[:, None] - hull
    part = np.clip((relative * edge).sum(-1) / (edge**2).sum(-1), 0, 1)
    away = np.linalg.norm(relative - part[..., None] * edge, axis=-1).min(-1)
    inside = (edge[:, 0] * relative[..., 1] - edge[:, 1] * relative[..., 0] > 0).all(-1)
    return np.where(inside, -away, away)


@EACH
def test_signed_distances_are_those_of_dense_polygons(shape):
    batch, poses = scenes((shape,), 40, 2)
    pixels = np.random.default_rng(0).uniform(-200, 600, (300, 2))
    with jax.enable_x64(True):
        distances = jax.jit(lambda arrays: signed_distance((shape,), arrays, jnp.asarray(pixels), LARGE))
        found = np.asarray(distances(arrays_of(batch, poses, np.float64)))
    chosen = np.nonzero(in_front(batch, poses))[0]
    assert len(chosen) > 20
    for row in chosen:
        (points,) = dense_picture((shape,), batch, poses[row, 0], row, LARGE)
        expected = distance_to_polygon(points, pixels)
        error = found[row, 0, 0] - expected
        # Never beyond the true distance; short of it by the angle between normals.
        assert error.max() < 1e-3
        allowed = (1 - np.cos(np.pi / 64)) * (np.abs(expected) + np.ptp(points, axis=0).max())
        assert (error > -2 * allowed - 1e-3).mean() > 0.99


@functools.cache
def hard_masks(kind: tuple) -> jax.stages.Wrapped:
    return jax.jit(lambda arrays: soft_masks(kind, arrays, jnp.asarray(pixel_grid(SMALL), jnp.float32), SMALL, 0.02))


@pytest.mark.parametrize("kind", [("sphere",), ("box", "cylinder", "sphere", "cylinder", "box")])
def test_narrow_masks_are_the_drawn_ones(kind):
    batch, poses = scenes(kind, 40, 9, 0.0)
    layers = np.asarray(hard_masks(kind)(arrays_of(batch, poses)))[:, 0]
    np.testing.assert_allclose(layers.sum(1), 1.0, atol=1e-5)
    counts, worst = [], 0
    for row in range(len(poses)):
        drawn = draw(poses[row], batch, SMALL, row)[0][0].ravel()
        for k in range(len(kind)):
            ours, theirs = layers[row, k + 1] > 0.5, drawn == k + 1
            counts.append((int((ours & theirs).sum()), int((ours | theirs).sum())))
            worst = max(worst, int((ours ^ theirs).sum()))
    assert sum(union for _, union in counts) > 5_000
    assert raster.pooled(counts) >= 0.99
    assert all(both >= 0.99 * union for both, union in counts if union > 300)


def test_wide_masks_add_up_and_hide():
    batch, poses = scenes(("box", "cylinder", "sphere", "box"), 10, 12, 0.0)
    pixels = jnp.asarray(pixel_grid((48, 32)), jnp.float32)
    wide = jax.jit(lambda arrays: soft_masks(batch.shapes, arrays, pixels, (48, 32), 4.0))
    layers = np.asarray(wide(arrays_of(batch, poses)))
    assert layers.shape == (10, 2, 5, 48 * 32)
    np.testing.assert_allclose(layers.sum(2), 1.0, atol=1e-5)
    assert layers.min() >= 0.0
    # A small sphere in front of a large one takes the pixels it covers, whatever their order.
    pair = jax.jit(lambda arrays: soft_masks(("sphere", "sphere"), arrays, jnp.array([[48.0, 32.0]]), SMALL, 1.0))
    for order in ([0, 1], [1, 0]):
        camera = (np.array([[0.0, 0.0, 5.0]]), np.zeros(1), np.full(1, 0.8))
        poses = np.tile([0.0, 0, 0, 1, 0, 0, 0], (1, 1, 2, 1))
        poses[0, 0, :, 2] = np.array([1.0, 3.0])[order]
        size = np.array([[[1.0, 0, 0], [0.2, 0, 0]]])[:, order]
        arrays = tuple(jnp.asarray(a, jnp.float32) for a in (poses, size, *camera))
        middle = pair(arrays)[0, 0, :, 0]
        near, far = 1 + order.index(1), 1 + order.index(0)
        assert float(middle[near]) > 0.95
        assert float(middle[far]) < 0.05


# Moments ------------------------------------------------------------------------------------------------------------------


@EACH
def test_moments_are_those_of_drawn_masks(shape):
    batch, poses = scenes((shape,), 100, 3)
    found = jax.jit(lambda a: moments((shape,), a, LARGE))(arrays_of(batch, poses))
    off = []
    for row in range(len(poses)):
        seen = mask_moments(draw(poses[row], batch, LARGE, row)[0][:1], (1,))
        if not seen.area[0, 0] > 1500:
            continue
        assert float(found.area[row, 0, 0]) == pytest.approx(float(seen.area[0, 0]), rel=0.01)
        off.append(np.abs(found.centroid[row, 0, 0] - seen.centroid[0, 0]).max())
        # Counting pixels is itself wrong by up to 0.15 px where an edge runs along them: finer ones decide.
        fine = mask_moments(draw(poses[row, :1], batch, (4 * LARGE[0], 4 * LARGE[1]), row)[0], (1,))
        assert float(found.area[row, 0, 0]) == pytest.approx(float(fine.area[0, 0]) / 16, rel=0.004)
        np.testing.assert_allclose(found.centroid[row, 0, 0], np.asarray(fine.centroid[0, 0]) / 4, atol=0.05)
        second = np.asarray(fine.second[0, 0]) / 16
        np.testing.assert_allclose(found.second[row, 0, 0], second, atol=0.004 * np.trace(second))
    assert len(off) >= 12
    assert np.percentile(off, 90) < 0.1


@EACH
def test_moments_are_those_of_dense_polygons(shape):
    batch, poses = scenes((shape,), 60, 13)
    with jax.enable_x64(True):
        found = jax.tree.map(
            np.asarray, jax.jit(lambda a: moments((shape,), a, LARGE))(arrays_of(batch, poses, np.float64))
        )
    chosen = np.nonzero(in_front(batch, poses))[0]
    assert len(chosen) > 30
    for row in chosen:
        (points,) = dense_picture((shape,), batch, poses[row, 0], row, LARGE)
        hull = points[ConvexHull(points).vertices]
        corner = np.stack([np.broadcast_to(hull[0], hull[1:-1].shape), hull[1:-1], hull[2:]], 1)
        a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
        centre = (area[:, None] * corner.mean(1)).sum(0) / area.sum()
        relative = corner - centre
        # A triangle's second moments are those of the middles of its edges.
        middles = (relative + np.roll(relative, 1, 1)) / 2
        second = np.einsum("t,tki,tkj->ij", area / 3, middles, middles) / area.sum()
        assert found.area[row, 0, 0] == pytest.approx(area.sum(), rel=1e-5)
        np.testing.assert_allclose(found.centroid[row, 0, 0], centre, atol=1e-5 * np.ptp(points))
        np.testing.assert_allclose(found.second[row, 0, 0], second, rtol=1e-5, atol=1e-5 * np.trace(second))


def test_masks_that_are_cut_have_no_moments():
    masks = np.zeros((6, 40, 60), np.int32)
    masks[:, 10:20, 10:30] = 4
    masks[1, 19:25, 20:25] = 7
    masks[2, 0:20, 10:30] = 4
    masks[3] = 0
    masks[4, 10:20, 30:60] = 4
    masks[5, 22:25, 20:25] = 7
    seen = mask_moments(masks, (4, 7))
    np.testing.assert_array_equal(np.isfinite(seen.area[:, 0]), [True, False, False, False, False, True])
    np.testing.assert_allclose(seen.centroid[0, 0], [20.0, 15.0])
    np.testing.assert_allclose(seen.second[0, 0], np.diag([20**2 - 1, 10**2 - 1]) / 12)


# Residuals ----------------------------------------------------------------------------------------------------------------


def seen_of(batch: SceneBatch, poses: np.ndarray) -> Features:
    """What a clip of the scene shows of it."""
    masks, flow = draw(poses[0], batch, LARGE)
    ids = tuple(range(1, len(batch.shapes) + 1))
    found = outlines(masks)
    assert found.ids == ids
    pixels, seen = flow_points(masks, flow, ids)
    return Features(found.support, mask_moments(masks, ids), pixels, seen)


def clip() -> tuple[SceneBatch, np.ndarray]:
    """One of each shape, apart, moving a little between two frames."""
    lookout = np.array([[0.0, -4.0, 3.0]])
    batch, _ = scenes(KIND, 1, 0)
    batch = dataclasses.replace(
        batch,
        size=np.array([[[0.3, 0.2, 0.25], [0.2, 0.3, 0.0], [0.25, 0.0, 0.0]]]),
        camera_position=lookout,
        camera_pitch=np.array([np.deg2rad(60.0)]),
        camera_fovy=np.array([np.deg2rad(50.0)]),
    )
    poses = np.zeros((1, 2, 3, 7))
    poses[..., :3] = [[-1.0, 0.2, 0.6], [0.0, 0.3, 0.7], [1.0, 0.0, 0.6]]
    turn = np.array([[0.9, 0.3, 0.1, 0.3], [0.7, 0.5, 0.3, 0.1], [1.0, 0.0, 0.0, 0.0]])
    poses[..., 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    poses[:, 1, :, :3] += [0.02, 0.01, -0.03]
    return batch, poses


compare = jax.jit(residuals, static_argnums=(0, 3))


def test_residuals_of_the_scene_itself_are_those_of_counting_pixels():
    batch, poses = clip()
    seen = seen_of(batch, poses)
    found = compare(batch.shapes, arrays_of(batch, poses), seen, LARGE)
    assert np.abs(found.reach).max() < 1.5
    assert np.abs(found.radius).max() < 0.1
    assert np.abs(found.centroid).max() < 0.1
    assert np.abs(found.spread).max() < 0.1
    assert np.abs(found.flow).max() < 1e-3
    assert np.count_nonzero(found.reach) == found.reach.size
    assert np.isfinite(np.asarray(seen.flow)[0]).all()
    other = dataclasses.replace(seen, flow=np.asarray(seen.flow) + 1.5)
    moved = compare(batch.shapes, arrays_of(batch, poses), other, LARGE).flow
    np.testing.assert_allclose(moved[:, 0], -1.5, atol=1e-3)
    np.testing.assert_array_equal(moved[:, 1], 0.0)
    assert found.flat().shape == (1, 2 * 3 * (16 + 1 + 2 + 3 + 2 * 12))


@pytest.mark.parametrize("part", ["reach", "centroid"])
def test_residuals_pull_objects_back_from_200_pixels_away(part):
    batch, poses = clip()
    seen = seen_of(batch, poses)
    arrays = arrays_of(batch, poses)
    focal = LARGE[1] / 2 / np.tan(batch.camera_fovy[0] / 2)
    depth = 5.0

    def cost(moved):
        found = compare(batch.shapes, (moved, *arrays[1:]), seen, LARGE)
        return 0.5 * (getattr(found, part) ** 2).sum()

    generator = np.random.default_rng(0)
    slope = jax.jit(jax.grad(cost))
    for _ in range(10):
        # Across the view: the camera's right and its up.
        angle = generator.uniform(0, 2 * np.pi, 3)
        tilt = batch.camera_pitch[0]
        aside = np.cos(angle)[:, None] * [1.0, 0.0, 0.0]
        aside = aside + np.sin(angle)[:, None] * np.array([0.0, np.cos(tilt), np.sin(tilt)])
        away = 200.0 * depth / focal * aside
        moved = poses.copy()
        moved[..., :3] += away
        masks = draw(moved[0], batch, LARGE)[0]
        assert not ((masks > 0) & (masks == draw(poses[0], batch, LARGE)[0])).any()
        downhill = -np.asarray(slope(jnp.asarray(moved, jnp.float32)))[0, :, :, :3]
        assert np.isfinite(downhill).all()
        pull = (downhill * -aside).sum(-1)
        assert (pull > 0.5 * np.linalg.norm(downhill, axis=-1)).all()
        assert (pull > 100.0).all()


def test_size_and_turn_show_in_radius_and_spread():
    batch, poses = clip()
    seen = seen_of(batch, poses)
    larger = dataclasses.replace(batch, size=batch.size * 1.2)
    found = compare(batch.shapes, arrays_of(larger, poses), seen, LARGE)
    radius = np.sqrt(np.asarray(seen.moments.area) / np.pi)
    np.testing.assert_allclose(found.radius[0] / radius, 0.2, atol=0.03)
    turned = poses.copy()
    turned[..., 0, 3:] = [1.0, 0.0, 0.0, 0.0]
    assert np.abs(compare(batch.shapes, arrays_of(batch, turned), seen, LARGE).spread[0, :, 0]).max() > 1.0


def test_flow_at_points_is_that_of_the_drawn_pictures():
    batch, poses = scenes(KIND, 12, 15)
    grid = pixel_grid(SMALL)
    pixels = np.broadcast_to(grid, (2, 3, *grid.shape))
    found = point_flow(poses, batch, pixels, SMALL)
    for row in range(len(poses)):
        masks, flow = draw(poses[row], batch, SMALL, row)
        for n in range(3):
            mine = (masks[0] == n + 1).ravel()
            np.testing.assert_allclose(found[row, 0, n][mine], flow[0].reshape(-1, 2)[mine], atol=2e-3)
