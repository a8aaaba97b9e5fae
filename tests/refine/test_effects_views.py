"""Effects in how a rollout is seen, against projections by hand and other libraries."""

from __future__ import annotations

import dataclasses

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effect_scenes import effect
from scipy import ndimage

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.effects import acting, batch_with_effects
from mjx_refine.effects.mask_bias import inner
from mjx_refine.evaluate import evaluate_scene
from mjx_refine.scene import Body, Camera, Effect, Samples, Scene
from mjx_refine.search import Options, refine
from mjx_refine.search.problem import Problem
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.simulate import simulate
from mjx_refine.view import rows
from mjx_refine.view.effects import draw_effects, needs_pictures
from mjx_refine.view.exposure import poses_at, straightened
from mjx_refine.view.frames import make_frames
from mjx_refine.view.picture import draw
from mjx_refine.view.picture_scorer import PictureScorer
from mjx_refine.view.seen import seen_point_flow, seen_supports

FPS = 30.0
SIZE = (240, 160)
PITCH = np.deg2rad(60.0)
CAMERA = Camera((0.2, -3.0, 2.0), 60.0, 45.0)
FOCAL = SIZE[1] / 2 / np.tan(np.deg2rad(22.5))


def batch_of(*effects: Effect, scene: Scene | None = None) -> SceneBatch:
    return batch_with_effects([dataclasses.replace(scene or SCENE, effects=effects)])


SCENE = Scene(
    (
        Body("sphere", "ball", (0.25,), (-0.6, 0.3, 0.8), (1.0, 0.0, 0.0, 0.0), (2.5, 0.0, 1.0), (0.0, 3.0, 0.0)),
        Body("box", "crate", (0.3, 0.2, 0.2), (0.7, 0.2, 0.2), linear_velocity=(-2.0, 0.5, 0.0)),
    ),
    CAMERA,
)

# A camera that looks straight down on things that float without gravity: pictures of the plane are to scale.
HEIGHT = 4.0
SCALE = FOCAL / HEIGHT
ABOVE = Camera((0.0, 0.0, HEIGHT + 1.0), 0.0, 45.0)


def afloat(shape: str = "box", size=(0.5, 0.6, 0.01), **state) -> Scene:
    state = {"position": (0.0, 0.0, 1.0), **state}
    return Scene((Body(shape, "thing", size, **state),), ABOVE, (0.0, 0.0, 0.0))


def pictures(scene: Scene, *effects: Effect, frames: int = 4, size=SIZE) -> tuple[np.ndarray, np.ndarray]:
    told = simulate(dataclasses.replace(scene, effects=effects), size, frames, FPS)
    assert told.masks is not None
    return told.masks, told.flow


# Camera -----------------------------------------------------------------------------------------------------------------

RIGHT, UP, BACK = np.array([[1, 0, 0], [0, np.cos(PITCH), np.sin(PITCH)], [0, -np.sin(PITCH), np.cos(PITCH)]], float)


def by_hand(point: np.ndarray, eye: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    away, ahead = point - eye, np.cross(up, right)
    return np.array([SIZE[0] / 2, SIZE[1] / 2]) + FOCAL * np.array([away @ right, -(away @ up)]) / (away @ ahead)


def still(point: np.ndarray) -> np.ndarray:
    return by_hand(point, np.array(CAMERA.position), RIGHT, UP)


def turned(vector: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    c, s = np.cos(angle), np.sin(angle)
    return c * vector + s * np.cross(axis, vector) + (1 - c) * (axis @ vector) * axis


POINT = np.array([0.9, 1.2, 0.4])
FRAME = 6
TIME = FRAME / FPS


def _seen(entry: Effect) -> np.ndarray:
    """Where the still camera sees what the moving one sees of ``POINT`` in frame ``FRAME``."""
    poses = np.tile(np.concatenate([POINT, [1.0, 0.0, 0.0, 0.0]]), (1, 10, 2, 1))
    return still(acting.apparent(poses, batch_of(entry), FPS)[0, FRAME, 0, :3])


@pytest.mark.parametrize(
    ("entry", "axis", "angle"),
    [
        (effect("camera_motion", pan=40.0), UP, -np.deg2rad(40.0) * TIME),
        (effect("camera_motion", tilt=40.0), RIGHT, np.deg2rad(40.0) * TIME),
        (effect("camera_roll", angle=25.0), BACK, np.deg2rad(25.0)),
        (effect("camera_shake", yaw=[0.0] * 6 + [3.0] + [0.0] * 3, pitch=[0.0] * 10), UP, -np.deg2rad(3.0)),
        (effect("camera_shake", yaw=[0.0] * 10, pitch=[0.0] * 6 + [3.0] + [0.0] * 3), RIGHT, np.deg2rad(3.0)),
    ],
    ids=["pan", "tilt", "roll", "shake yaw", "shake pitch"],
)
def test_turns_of_the_camera(entry, axis, angle):
    expected = by_hand(POINT, np.array(CAMERA.position), turned(RIGHT, axis, angle), turned(UP, axis, angle))
    np.testing.assert_allclose(_seen(entry), expected, atol=1e-9)


def test_directions_of_turns():
    """To the right, what is seen moves left; upwards, down; a camera rolled counter-clockwise turns the picture clockwise."""
    x, y = still(POINT)
    assert _seen(effect("camera_motion", pan=40.0))[0] < x - 10
    assert _seen(effect("camera_motion", tilt=40.0))[1] > y + 10
    middle = np.array([SIZE[0] / 2, SIZE[1] / 2])
    before, after = still(POINT) - middle, _seen(effect("camera_roll", angle=25.0)) - middle
    # y points down: from x to y is clockwise.
    assert np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after) == pytest.approx(np.deg2rad(25.0))


def test_travel_of_the_camera():
    entry = effect("camera_motion", x=0.5, y=-0.3, z=0.8)
    eye = np.array(CAMERA.position) + TIME * np.array([0.5, -0.3, 0.8])
    np.testing.assert_allclose(_seen(entry), by_hand(POINT, eye, RIGHT, UP), atol=1e-9)


def test_a_rolled_picture_is_the_picture_turned():
    masks = pictures(SCENE, size=(160, 160))[0]
    rolled = pictures(SCENE, effect("camera_roll", angle=30.0), size=(160, 160))[0]
    expected = ndimage.rotate(masks[0] > 0, -30.0, reshape=False, order=0)
    both = ((rolled[0] > 0) & expected).sum() / ((rolled[0] > 0) | expected).sum()
    # A floor that stayed level would hide a part of the crate.
    assert both > 0.96


def test_the_floor_flows_beside_the_objects():
    masks, flow = pictures(afloat(position=(0.0, 0.0, 1.0)), effect("camera_motion", x=0.6, y=0.3))
    background = flow[masks[:-1] == 0]
    # The floor is 5 m below, the thing 4.
    np.testing.assert_allclose(
        background, np.tile([-FOCAL * 0.02 / 5, FOCAL * 0.01 / 5], (len(background), 1)), atol=1e-3
    )
    near = flow[masks[:-1] > 0]
    np.testing.assert_allclose(near, np.tile([-FOCAL * 0.02 / 3.99, FOCAL * 0.01 / 3.99], (len(near), 1)), atol=1e-3)


def test_far_things_flow_with_a_pan():
    level = Scene(SCENE.objects, Camera((0.0, -3.0, 2.0), 90.0, 45.0))
    _, flow = pictures(level, effect("camera_motion", pan=15.0))
    np.testing.assert_allclose(flow[0, 10, 120], [-FOCAL * np.tan(np.deg2rad(0.5)), 0.0], atol=0.01)


# Lens -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k1", [-0.25, 0.3])
def test_the_lens_is_opencvs(k1):
    points = np.random.default_rng(0).uniform([0, 0], SIZE, (200, 2))
    rays = np.concatenate([(points - np.array(SIZE) / 2) / FOCAL, np.ones((200, 1))], 1)
    matrix = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    expected = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, np.array([k1, 0.0, 0.0, 0.0]))[0][
        :, 0
    ]
    batch = batch_of(effect("lens_distortion", k1=k1))
    bent = acting.warped(batch, points[None], np.array([FOCAL]), SIZE)
    np.testing.assert_allclose(bent[0], expected, atol=1e-6)
    back, lit = straightened(batch, bent, np.array([FOCAL]), SIZE)
    np.testing.assert_allclose(back[0], points, atol=1e-6)
    assert lit.all()


def test_beyond_a_lens_largest_circle_nothing_is_seen():
    # r (1 - r^2) is at most 0.385, at r = 0.577.
    batch = batch_of(effect("lens_distortion", k1=-1.0))
    points = np.array([[[120.0 + FOCAL * r, 80.0] for r in (0.1, 0.38, 0.39, 0.6)]])
    assert straightened(batch, points, np.array([FOCAL]), SIZE)[1].tolist() == [[True, True, False, False]]
    masks, flow = pictures(SCENE, effect("lens_distortion", k1=-1.0), effect("camera_motion", x=1.0))
    assert np.abs(flow[:, 0, 0]).max() == 0
    assert np.abs(flow[:, 60, 120]).min() > 0
    assert not masks[:, 0, 0].any()


@pytest.mark.parametrize("k1", [-0.3, 0.3])
def test_masks_and_flow_are_bent(k1):
    (plain, flow), (masks, bent) = pictures(SCENE), pictures(SCENE, effect("lens_distortion", k1=k1))
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    points = np.stack([columns, rows], -1).reshape(1, -1, 2) + 0.5
    batch, focal = batch_of(effect("lens_distortion", k1=k1)), np.array([FOCAL])
    straight = straightened(batch, points, focal, SIZE)[0]
    place = straight[0, :, ::-1].T - 0.5
    expected = ndimage.map_coordinates(plain[0], place, order=0).reshape(masks[0].shape)
    assert (expected != masks[0]).mean() < 0.003
    assert (plain[0] != masks[0]).mean() > 0.002
    inside = ndimage.binary_erosion(masks[0] == 2, iterations=3)
    ends = straight[0] + np.stack([ndimage.map_coordinates(flow[0, ..., k], place, order=1) for k in range(2)], -1)
    moved = (acting.warped(batch, ends[None], focal, SIZE) - points).reshape(*masks[0].shape, 2)
    # Flow has kinks at the crate's edges.
    assert np.median(np.abs(moved - bent[0])[inside]) < 0.005


# Timing -----------------------------------------------------------------------------------------------------------------


def test_rows_of_a_rolling_shutter_are_late():
    scene = afloat(linear_velocity=(1.2, 0.0, 0.0))
    readout, speed = 0.02, 1.2 * FOCAL / 3.99
    masks, flow = pictures(scene, effect("rolling_shutter", readout=readout))
    plain, _ = pictures(scene)
    rows = np.nonzero((plain[1] > 0).any(1))[0][1:-1]
    for edge in (np.argmax, lambda row: -np.argmax(row[::-1])):
        shift = np.array([float(edge(masks[1, r] > 0)) - float(edge(plain[1, r] > 0)) for r in rows])
        expected = speed * readout * ((rows + 0.5) / SIZE[1] - 0.5)
        assert np.abs(shift - expected).max() < 1.01
        assert abs((shift - expected).mean()) < 0.15
    np.testing.assert_allclose(flow[masks[:-1] > 0][:, 0], speed / FPS, atol=1e-3)


@pytest.mark.parametrize("speed", [1.2, -1.2])
def test_a_rolling_shutter_follows_or_meets_what_moves_along_its_rows(speed):
    # Upwards in the world is upwards in the picture.
    masks, flow = pictures(afloat(linear_velocity=(0.0, speed, 0.0)), effect("rolling_shutter", readout=0.02))
    w = -speed * FOCAL / 3.99 / FPS
    # The point is seen again where its row is exposed: f = w (1 + c f), c frames a row.
    rate = 0.02 * FPS / SIZE[1]
    np.testing.assert_allclose(flow[masks[:-1] > 0][:, 1], w / (1 - rate * w), atol=1e-3)
    height = (masks[1] > 0).sum(0).max()
    assert height == pytest.approx(1.2 * FOCAL / 3.99 / (1 - rate * w), abs=1.01)


def test_poses_between_frames():
    time, spin = np.arange(6.0), np.array([0.2, -0.1, 0.4])
    path = np.stack([time, 2 * time**2, 1 - time], -1)
    quaternion = rotations.exponential(time[:, None] * spin)
    poses = np.concatenate([path, quaternion], -1)[None, :, None]
    times = np.array([[-0.4, 0.0, 0.7, 2.5, 4.9, 5.3]])
    told = poses_at(poses, times)[0, :, 0]
    t = times[0]
    np.testing.assert_allclose(told[:, :3], np.stack([t, 2 * t**2, 1 - t], -1), atol=1e-9)
    np.testing.assert_allclose(told[:, 3:], rotations.exponential(t[:, None] * spin), atol=1e-9)


# Perception -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [-3.0, 0.4, 4.3])
def test_a_biased_mask_of_a_disc(width):
    scene = afloat("sphere", (0.7,))
    masks, flow = pictures(scene, effect("mask_bias", width=width))
    plain = pictures(scene)[0]
    radius = np.sqrt((plain[0] > 0).sum() / np.pi)
    assert np.sqrt((masks[0] > 0).sum() / np.pi) - radius == pytest.approx(width, abs=0.2)
    assert np.abs(flow).max() < 1e-4


@pytest.mark.parametrize("turn", [0.0, 0.2, 0.6])
def test_what_shrinks_keeps_its_corners(turn):
    angle = 2 * np.pi * np.arange(128) / 128
    square = np.abs(np.cos(angle - turn)) + np.abs(np.sin(angle - turn))
    apart = 300 * np.cos(angle) - 40 * np.sin(angle)
    thin = inner(40.0 * square + apart - 7.0)
    np.testing.assert_allclose(thin, 33.0 * square + apart, atol=0.35)
    np.testing.assert_allclose(inner(40.0 + apart - 7.0), 33.0 + apart)


def test_fat_masks_grow_over_background_alone():
    pair = (Body("box", "a", (0.3, 0.3, 0.1), (-0.3, 0.0, 1.0)), Body("box", "b", (0.3, 0.3, 0.1), (0.3, 0.0, 1.0)))
    scene = Scene(pair, ABOVE, (0.0, 0.0, 0.0))
    plain, masks = pictures(scene)[0], pictures(scene, effect("mask_bias", width=2.0))[0]
    assert (masks[plain > 0] == plain[plain > 0]).all()
    grown = (masks[0] > 0) & (plain[0] == 0)
    assert set(np.unique(ndimage.distance_transform_cdt(plain[0] == 0, "chessboard")[grown])) == {1, 2}


def test_an_occluder_hides_its_rectangle_and_nothing_else():
    entry = effect("occluder", left=100.0, top=60.4, right=150.0, bottom=120.0)
    (plain, flow), (masks, seen) = pictures(SCENE), pictures(SCENE, entry)
    inside = np.zeros(plain.shape[1:], bool)
    inside[60:120, 100:150] = True
    assert (plain[0][inside] > 0).any()
    assert not masks[:, inside].any()
    assert not seen[:, inside].any()
    np.testing.assert_array_equal(masks[:, ~inside], plain[:, ~inside])
    np.testing.assert_allclose(seen[:, ~inside], flow[:, ~inside], atol=1e-4)


def test_an_occluder_of_a_moving_camera_is_passed_by_the_background():
    entries = (effect("occluder", left=90.0, top=50.0, right=150.0, bottom=110.0), effect("camera_motion", x=0.6))
    masks, flow = pictures(afloat(), *entries)
    assert not masks[:, 60:100, 100:140].any()
    np.testing.assert_allclose(flow[:, 60:100, 100:140, 0], -FOCAL * 0.02 / 5, atol=1e-3)


# What least squares compares --------------------------------------------------------------------------------------------

DRAWN = (
    effect("camera_motion", pan=20.0, x=0.4),
    effect("camera_roll", angle=12.0),
    effect("lens_distortion", k1=0.25),
    effect("rolling_shutter", readout=0.015),
    effect("mask_bias", width=3.0),
    effect("shape", "ball", bulge=[0.0, 0.0, 0.0, 0.06] + [0.0] * 17),
    effect("shape", "crate", bulge=[0.0] * 21, taper=0.2),
)


@pytest.mark.parametrize("entry", DRAWN, ids=lambda e: e.effect)
def test_outlines_and_flow_are_those_of_the_pictures(entry):
    batch = batch_of(entry)
    poses = MujocoSimulator(batch.shapes, FPS, 1).rollout(batch, 4)
    masks, flow = draw_effects(poses[0], batch, SIZE, FPS)
    reach = seen_supports(poses, batch, SIZE, 16, FPS)[0]
    angle = 2 * np.pi * np.arange(16) / 16
    rows, columns = np.nonzero(masks[1] == 1)
    drawn = (np.stack([columns + 0.5, rows + 0.5], -1) @ np.stack([np.cos(angle), np.sin(angle)])).max(0)
    assert np.abs(reach[1, 0] - drawn - 0.35).max() < 0.8
    middle = np.round([columns.mean(), rows.mean()]).astype(int)
    pixels = np.full((4, 2, 1, 2), 60.0)
    pixels[1, 0, 0] = middle + 0.5
    told = seen_point_flow(poses, batch, pixels, SIZE, FPS)[0, 1, 0, 0]
    np.testing.assert_allclose(told, flow[1, middle[1], middle[0]], atol=0.08)


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_a_thin_box_is_thin_at_its_corners_as_in_its_picture(turn):
    box = afloat("box", (0.6, 0.4, 0.2), orientation=(np.cos(turn), 0.0, 0.1, np.sin(turn)))
    batch = batch_with_effects([dataclasses.replace(box, effects=(effect("mask_bias", width=-6.0),))])
    poses = MujocoSimulator(batch.shapes, FPS, 1).rollout(batch, 2)
    masks, _ = draw_effects(poses[0], batch, SIZE, FPS)
    angle = 2 * np.pi * np.arange(16) / 16
    rows, columns = np.nonzero(masks[0] == 1)
    drawn = (np.stack([columns + 0.5, rows + 0.5], -1) @ np.stack([np.cos(angle), np.sin(angle)])).max(0)
    told = seen_supports(poses, batch, SIZE, 16, FPS)[0, 0, 0]
    assert np.abs(told - drawn - 0.35).max() < 0.9
    plain = seen_supports(poses, dataclasses.replace(batch, effects=()), SIZE, 16, FPS)[0, 0, 0]
    assert (plain - 6.0 - drawn).max() > 1.5


QUICK = ("camera_motion", "lens_distortion", "camera_roll")
"""The others compile more."""

SCORED = [
    pytest.param(e, id=e.effect, marks=[] if e.effect in QUICK else pytest.mark.slow)
    for e in (*DRAWN, effect("slope", x=3.0), effect("drag", "ball", quadratic=0.5))
]


@pytest.mark.parametrize("entry", SCORED)
def test_a_scene_scores_full_marks_on_its_own_clip(entry):
    scene = dataclasses.replace(SCENE, effects=(entry,))
    clip = simulate(scene, (96, 64), 4, FPS)
    told = evaluate_scene(scene, clip)
    assert told["iou"] == 1.0
    assert told["epe"] < 1e-3
    assert evaluate_scene(SCENE, clip)["fitness"] < told["fitness"] - 1e-4
    batch = batch_with_effects([scene])
    if needs_pictures(batch):
        poses = MujocoSimulator(batch.shapes, FPS, 1).rollout(batch, 4)
        scores = PictureScorer(batch.shapes, clip, (1, 2), (48, 32))(poses, batch)
        assert scores.iou[0] > (0.9 if entry.effect == "mask_bias" else 0.999)
        assert scores.epe[0] < 1e-3


def test_without_masks_the_moving_region_counts():
    scene = dataclasses.replace(SCENE, effects=(effect("lens_distortion", k1=0.2),))
    clip = dataclasses.replace(simulate(scene, (96, 64), 4, FPS), masks=None)
    assert evaluate_scene(scene, clip)["iou"] > 0.99


# Refinement -------------------------------------------------------------------------------------------------------------

TINY = Options(population=12, iterations=20, optimizer="gradient", backend="mujoco", threads=1, refits=0, starts=1)


SLOW = pytest.mark.slow
REFINED = [
    pytest.param((effect("camera_motion", pan=15.0), effect("drag", "ball", quadratic=0.5)), TINY, id="camera and drag"),
    pytest.param((effect("slope", x=6.0), effect("dropped_frames", frame=3, count=2)), TINY, id="slope and timing", marks=SLOW),
    pytest.param((effect("lens_distortion", k1=0.3),), dataclasses.replace(TINY, optimizer="hybrid"), id="lens", marks=SLOW),
]  # fmt: skip


@pytest.mark.parametrize(("effects", "options"), REFINED)
def test_effects_are_refined_with_the_rest(effects, options):
    crate = dataclasses.replace(SCENE.objects[1], position=(0.7, 0.2, 0.35))
    truth = dataclasses.replace(SCENE, objects=(SCENE.objects[0], crate), effects=effects)
    clip = simulate(truth, (96, 64), 4, FPS)
    ball = dataclasses.replace(truth.objects[0], position=(-0.55, 0.3, 0.78), linear_velocity=(2.3, 0.1, 1.1))
    result = refine(dataclasses.replace(truth, objects=(ball, crate)), clip, options)
    for found, true in zip(result.scene.effects, effects, strict=True):
        assert (found.effect, found.target, [k for k, _ in found.parameters]) == (
            true.effect,
            true.target,
            [k for k, _ in true.parameters],
        )
        for (_, a), (_, b) in zip(found.parameters, true.parameters, strict=True):
            assert a == pytest.approx(b, rel=0.35)
    assert result.refined.scores.fitness[0] > result.init.scores.fitness[0] + 0.01
    scored = evaluate_scene(result.scene, clip)
    assert scored["fitness"] == pytest.approx(float(result.refined.scores.fitness[0]), abs=1e-6)


def test_samples_with_and_without_effects_are_one_problem():
    clip = simulate(SCENE, (96, 64), 4, FPS)
    scenes = (SCENE, dataclasses.replace(SCENE, effects=(effect("camera_roll", angle=15.0),)))
    problem = Problem(Samples("<test>", scenes, (0, 1)), clip, TINY)
    assert [start.index for start in problem.starts] == [0, 1]
    assert problem.starts[0].fitness > problem.starts[1].fitness + 0.01


def test_objects_that_stand_on_a_slope_are_not_pushed_off_it():
    angle = np.deg2rad(15.0)
    turn = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
    place = rotations.rotate(turn, np.array([1.0, 0.0, 0.2]))
    crate = Body("box", "crate", (0.3, 0.2, 0.2), tuple(place), tuple(turn))
    scene = Scene((crate,), CAMERA, effects=(effect("slope", y=15.0),))
    clip = simulate(scene, (96, 64), 4, FPS)
    start = Problem(Samples("<test>", (scene,), (0,)), clip, TINY).starts[0]
    assert start.moved == 0.0
    assert start.scene == scene


def test_without_effects_the_pictures_are_the_plain_ones():
    batch = batch_of()
    poses = MujocoSimulator(batch.shapes, FPS, 1).rollout(batch, 4)
    for one, other in zip(draw_effects(poses[0], batch, SIZE, FPS), draw(poses[0], batch, SIZE), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not needs_pictures(batch_of(effect("drag", "ball", linear=1.0)))


def test_only_the_rectangles_around_outlines_are_looked_at(monkeypatch):
    """What is drawn there, few points at a time, is what looking at every point draws."""
    batch = batch_of()
    poses = np.concatenate([batch.position, batch.quaternion], -1)[:, None].repeat(2, 1)
    floor = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (1, 2, 1, 1))
    size = np.concatenate([batch.size, np.zeros((1, 1, 3))], 1)
    seen_from = batch.camera_position, batch.camera_pitch, batch.camera_fovy
    frames = make_frames(*map(jnp.asarray, (np.concatenate([poses, floor], 2), size, *seen_from)), SIZE[1])
    frames = jax.tree.map(lambda a: a[::2], frames)
    arrays = tuple(jnp.asarray(a) for a in (poses[:, :1], batch.size, *seen_from))
    x, y = np.meshgrid(np.arange(0.5, SIZE[0], 2), np.arange(0.5, SIZE[1], 2))
    at = jnp.asarray(np.stack([x.ravel(), y.ravel()], -1), jnp.float32)
    change = np.random.default_rng(0).normal(0, 4, (2, 16))
    some_hidden = np.where(np.arange(2)[:, None] == 1, np.nan, change)
    for added, seen in ((change, {0, 1, 2}), (some_hidden, {0, 1})):
        told = jnp.asarray(added, jnp.float32)
        distance = rows._changed_distance(batch.shapes, arrays, at, SIZE, told)
        centre = SIZE[0] / 2, SIZE[1] / 2
        whole = rows._cast_outlines(batch.shapes, frames, at[None, :, 0], at[None, :, 1], centre, distance)
        monkeypatch.setattr(rows, "PART", 100)
        parts = rows._changed_outlines(batch.shapes, frames, arrays, at, SIZE, told)
        for one, other in zip(parts, whole, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-3)
        assert set(np.unique(whole[0]).tolist()) == seen
