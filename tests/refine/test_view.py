"""Pictures against MuJoCo's rays and cameras; fast scores against the plain reference; outlines against pixels."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mjx_fitness import UNMATCHED, Weights, score_pictures

from benchmarks import raster
from mjx_refine.batch import SceneBatch, batch_from_scenes
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view import tiles
from mjx_refine.view.frames import frames_of_batch
from mjx_refine.view.outline import directions, supports
from mjx_refine.view.picture import draw
from mjx_refine.view.points import point_flow
from mjx_refine.view.tiles import TileScorer, foreground

SIZE = (97, 61)
"""No multiple of a tile's side."""


KIND = ("box", "cylinder", "sphere", "cylinder")


# Against MuJoCo ---------------------------------------------------------------------------------------------------------


def test_masks_and_flow_against_mujocos_rays():
    # One kind of scene, which compiles once; the benchmark has the others.
    generator = np.random.default_rng(5)
    scenes = [raster.random_scene(KIND, generator) for _ in range(40)]
    compared = [raster.compare(scene, (96, 64), generator) for scene in scenes]
    counts = [c for one in compared for c in one.counts]
    assert sum(either for _, either in counts) > 20_000
    assert raster.pooled(counts) >= 0.999
    errors = np.concatenate([one.flow_errors for one in compared])
    assert np.percentile(errors, 99.9) < 0.002
    assert errors.max() < 0.02


def test_the_comparison_notices_half_a_pixel():
    # The oracle must be able to fail: a camera a quarter of a pixel away is seen in masks and flow.
    scene = raster.random_scene(KIND, np.random.default_rng(2))
    batch = batch_from_scenes([scene])
    wrong = dataclasses.replace(batch, camera_pitch=batch.camera_pitch + 0.25 * batch.camera_fovy / 64)
    poses = raster.moved_poses(batch, np.random.default_rng(0))
    theirs, _ = raster.cast_by_mujoco(*raster.mujoco_scene(batch, poses[0]), scene.camera, (96, 64))
    right = raster.pooled(raster.counts_of(draw(poses, batch, (96, 64))[0][0], theirs, len(scene.objects)))
    assert (
        raster.pooled(raster.counts_of(draw(poses, wrong, (96, 64))[0][0], theirs, len(scene.objects))) < 0.999 <= right
    )


@pytest.mark.parametrize("pitch", [0.0, 45.0, 90.0, -30.0, 200.0])
def test_camera_is_mujocos_camera_rotated_about_x(pitch):
    spec = mujoco.MjSpec()
    spec.compiler.degree = True
    half = np.deg2rad(pitch) / 2
    spec.worldbody.add_camera(name="view", pos=[0.3, -2, 3.5], quat=[np.cos(half), np.sin(half), 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    to_world = data.cam_xmat[0].reshape(3, 3)
    # A body turned anyhow: `ray` takes camera coordinates to the body's, `next_matrix` goes the other way.
    turn = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])
    body = Body("box", "b", (0.1, 0.2, 0.3), (1.0, 2.0, 0.5), tuple(turn.tolist()))
    batch = batch_from_scenes([Scene((body,), Camera((0.3, -2.0, 3.5), pitch, 50.0))])
    poses = np.concatenate([batch.position, batch.quaternion], -1)[:, None]
    frames = frames_of_batch(poses, batch, 320)
    rotation = raster.rotation(turn)
    np.testing.assert_allclose(np.asarray(frames.ray)[0, 0], rotation.T @ to_world, atol=1e-6)
    np.testing.assert_allclose(np.asarray(frames.next_matrix)[0, 0], to_world.T @ rotation, atol=1e-6)
    centre = np.array([0.3, -2.0, 3.5])
    np.testing.assert_allclose(np.asarray(frames.origin)[0, 0], rotation.T @ (centre - body.position), atol=1e-5)
    np.testing.assert_allclose(np.asarray(frames.next_offset)[0, 0], to_world.T @ (body.position - centre), atol=1e-5)
    np.testing.assert_allclose(np.asarray(frames.down)[0], to_world[2], atol=1e-6)
    assert float(frames.focal[0]) == pytest.approx(160 / np.tan(np.deg2rad(25)), rel=1e-6)


def centroid(mask: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


@pytest.mark.parametrize(
    ("pitch", "position", "where"),
    [
        (0.0, (0.0, 0.0, 1.0), (0, 0)),  # Straight down: +y is up in the picture, +x right.
        (0.0, (0.5, 0.0, 1.0), (1, 0)),
        (0.0, (0.0, 0.5, 1.0), (0, -1)),
        (90.0, (0.0, 3.0, 4.0), (0, 0)),  # Along +y: +z is up, +x right.
        (90.0, (0.5, 3.0, 4.0), (1, 0)),
        (90.0, (0.0, 3.0, 4.5), (0, -1)),
        (45.0, (0.0, 4.0, 0.0), (0, 0)),  # The optical axis meets the floor as far ahead as the camera is high.
    ],
)
def test_where_things_are_in_the_picture(pitch, position, where):
    scene = Scene((Body("sphere", "s", (0.2,), position),), Camera((0.0, 0.0, 4.0), pitch, 45.0))
    masks, flow = draw(raster_poses(scene), batch_from_scenes([scene]), SIZE)
    offset = centroid(masks[0] == 1) - np.array(SIZE) / 2
    depth = 3.0 if pitch != 45.0 else 4 * np.sqrt(2)
    focal = SIZE[1] / 2 / np.tan(np.pi / 8)
    np.testing.assert_allclose(offset, np.array(where) * focal * 0.5 / depth, atol=0.6)
    assert flow.shape == (1, SIZE[1], SIZE[0], 2)
    np.testing.assert_allclose(flow, 0.0, atol=1e-4)


def raster_poses(scene: Scene) -> np.ndarray:
    """The scene's poses, twice."""
    batch = batch_from_scenes([scene])
    return np.repeat(np.concatenate([batch.position, batch.quaternion], -1), 2, 0)


# Scores -----------------------------------------------------------------------------------------------------------------

CAMERA = Camera((0.0, -2.5, 2.0), 55.0, 50.0)
BODIES = (
    Body("box", "box", (0.3, 0.2, 0.15), (-0.4, 0.3, 0.5), (0.9, 0.3, 0.1, 0.3), (1.5, 0.2, 1.0), (1.0, 2.0, 3.0)),
    Body("cylinder", "can", (0.2, 0.5), (0.5, 0.1, 0.4), (0.7, 0.7, 0.1, 0.0), (-1.0, 0.3, 1.0), (0.0, 0.0, 4.0)),
    Body("sphere", "ball", (0.2,), (0.0, 0.6, 0.6), (1.0, 0.0, 0.0, 0.0), (0.2, -1.0, 0.0), (3.0, 0.0, 0.0)),
)
BODIES = tuple(
    dataclasses.replace(b, orientation=tuple((np.array(b.orientation) / np.linalg.norm(b.orientation)).tolist()))
    for b in BODIES
)
SCENE = Scene(BODIES, CAMERA)
FRAMES = 5


def candidates(count: int, seed: int) -> SceneBatch:
    """The scene and others around it."""
    generator = np.random.default_rng(seed)
    batch = batch_from_scenes([SCENE] * count)
    noise = generator.normal(size=(count, 3, 3)) * np.linspace(0, 0.3, count)[:, None, None]
    return dataclasses.replace(
        batch,
        position=batch.position + noise,
        size=batch.size * np.exp(0.3 * noise),
        camera_pitch=batch.camera_pitch + 0.3 * noise[:, 0, 0],
        camera_fovy=batch.camera_fovy * np.exp(0.5 * noise[:, 0, 1]),
        camera_position=batch.camera_position + noise[:, 1],
    )


def observed(size=SIZE, ids=(4, 9, 2), **changes) -> Observation:
    """A clip of the scene, with flow missing here and there."""
    batch = batch_from_scenes([SCENE])
    poses = MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, FRAMES)
    masks, flow = draw(poses[0], batch, size)
    generator = np.random.default_rng(8)
    flow = (flow + 0.05 * generator.normal(size=flow.shape)).astype(np.float32)
    flow[generator.random(flow.shape[:3]) < 0.2] = np.nan
    flow[0, :10] = np.nan
    masks = np.array([0, *ids], np.int32)[masks]
    return dataclasses.replace(Observation(flow, masks, 30.0), **changes)


def reference(poses: np.ndarray, batch: SceneBatch, clip: Observation, matching, weights=None):
    """The plain scores, one candidate after the other, as fields of stacked arrays."""
    rows = []
    for row in range(len(batch)):
        masks, flow = draw(poses[row], batch, clip.size, row)
        if clip.masks is None:
            moving = (flow.astype(np.float64) ** 2).sum(-1) > 0.25
            masks = np.where(np.concatenate([moving, np.zeros_like(moving[:1])]), masks, 0)
        rows.append(score_pictures(masks, flow, foreground(clip), clip.flow, matching, weights))
    return {f.name: np.concatenate([getattr(r, f.name) for r in rows]) for f in dataclasses.fields(rows[0])}


def assert_same_scores(scores, expected) -> None:
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(scores, name), values, rtol=2e-5, atol=2e-5, err_msg=name)


WEIGHTS = Weights(1.0, 0.5, 0.3, 0.2)


@pytest.mark.parametrize("size", [SIZE, (8, 8)])
@pytest.mark.parametrize("matching", [(4, 9, 2), (9, UNMATCHED, 4), (UNMATCHED,) * 3])
def test_scores_equal_the_plain_reference(size, matching):
    clip = observed(size)
    batch = candidates(9, 1)
    poses = MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, FRAMES)
    scores = TileScorer(batch.shapes, clip, matching, weights=WEIGHTS)(poses, batch)
    assert_same_scores(scores, reference(poses, batch, clip, matching, WEIGHTS))
    assert 0 < scores.iou[0] <= 1


@pytest.mark.parametrize("kind", ["no masks", "no flow", "an empty first frame", "one mask only"])
def test_scores_of_clips_that_lack_something(kind):
    clip = observed()
    assert clip.masks is not None
    changed = {
        "no masks": {"masks": None, "flow": clip.flow * 3},
        "no flow": {"flow": clip.flow * np.nan},
        "an empty first frame": {"masks": clip.masks * (np.arange(FRAMES) > 0)[:, None, None]},
        "one mask only": {"masks": np.where(clip.masks == 4, 4, 0)},
    }[kind]
    clip = dataclasses.replace(clip, **changed)
    matching = (1, UNMATCHED, UNMATCHED) if kind == "no masks" else (4, UNMATCHED, UNMATCHED)
    batch = candidates(5, 2)
    poses = MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, FRAMES)
    scores = TileScorer(batch.shapes, clip, matching)(poses, batch)
    assert_same_scores(scores, reference(poses, batch, clip, matching))
    assert np.isfinite(scores.fitness).all()


def placed(shape: str, size: tuple[float, ...], along: float, aside: float = 0.0, pitch: float = 55.0):
    """(poses of five frames, batch) with an object ``along`` metres in front of the camera that drifts a little."""
    camera = dataclasses.replace(CAMERA, orientation=pitch, position=(0.0, 0.0, 30.0))
    axes = raster.camera_axes(camera)
    centre = np.array(camera.position) - along * axes[:, 2] + aside * axes[:, 0]
    turn = tuple((np.array([0.5, 0.5, -0.3, 0.2]) / np.linalg.norm([0.5, 0.5, -0.3, 0.2])).tolist())
    scene = Scene((Body(shape, "b", size, tuple(centre.tolist()), turn),), camera)  # type: ignore[arg-type]
    batch = batch_from_scenes([scene])
    poses = np.repeat(np.concatenate([batch.position, batch.quaternion], -1)[None], FRAMES, 1)
    poses = poses.reshape(1, FRAMES, 1, 7)
    poses[..., :3] += 0.02 * np.arange(FRAMES)[:, None, None] * axes[:, 0]
    return poses, batch


LARGE = (480, 320)
PLACES = {
    "behind the camera": (-3.0, 0.0),
    "in the camera's plane": (0.0, 1.5),
    "across the camera's plane": (0.3, 1.4),
    "so near that it fills the view": (1.6, 0.0),
    "near, at the edge": (1.5, 1.3),
    "near, beyond the edge": (1.3, 1.9),
    "large": (4.0, 1.0),
    "outside of the view": (4.0, 8.0),
    "far away": (300.0, 0.0),
}


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
@pytest.mark.parametrize("shape", ["sphere", "box", "cylinder"])
def test_no_tile_is_missed_wherever_the_object_is(shape, place):
    size = {"sphere": (1.0,), "box": (0.5, 0.6, 0.5), "cylinder": (1.0, 0.5)}[shape]
    poses, batch = placed(shape, size, *place)
    generator = np.random.default_rng(0)
    masks = np.zeros((FRAMES, LARGE[1], LARGE[0]), np.int32)
    masks[:, 100:200, 100:300] = 1
    clip = Observation(generator.normal(size=(FRAMES - 1, LARGE[1], LARGE[0], 2)).astype(np.float32), masks, 30.0)
    scores = TileScorer(batch.shapes, clip, (1,))(poses, batch)
    expected = reference(poses, batch, clip, (1,))
    # Sums must be exact here: a missed tile of thin edge would hide in any tolerance.
    np.testing.assert_allclose(scores.frame_iou, expected["frame_iou"], rtol=1e-6)
    np.testing.assert_allclose(scores.frame_epe, expected["frame_epe"], rtol=1e-5)


def test_large_spheres_and_cylinders_lose_no_tile():
    generator = np.random.default_rng(1)
    clip = Observation(np.zeros((FRAMES - 1, LARGE[1], LARGE[0], 2), np.float32), None, 30.0)
    clip = dataclasses.replace(clip, masks=np.ones((FRAMES, LARGE[1], LARGE[0]), np.int32))
    for shape, size in (("sphere", (1.0,)), ("cylinder", (1.0, 0.2))):
        scorer = TileScorer((shape,), clip, (1,))
        for _ in range(12):
            poses, batch = placed(shape, size, generator.uniform(1.2, 3.0), generator.uniform(-2.5, 2.5))
            assert_same_scores(scorer(poses, batch), reference(poses, batch, clip, (1,)))


def test_candidates_that_diverged():
    clip = observed()
    batch = candidates(4, 3)
    poses = MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, FRAMES)
    poses[1, 3:] = np.nan
    poses[2, 0, 1, 2] = np.inf
    scores = TileScorer(batch.shapes, clip, (4, 9, 2))(poses, batch)
    np.testing.assert_array_equal(np.isneginf(scores.fitness), [False, True, True, False])
    np.testing.assert_array_equal(scores.iou[1:3], 0.0)
    sound = TileScorer(batch.shapes, clip, (4, 9, 2))(poses[[0, 3]], batch[np.array([0, 3])])
    np.testing.assert_array_equal(scores.fitness[[0, 3]], sound.fitness)


def test_a_candidates_score_does_not_depend_on_its_company():
    clip, batch = observed(), candidates(40, 4)
    poses = MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, FRAMES)
    scorer = TileScorer(batch.shapes, clip, (4, 9, 2))
    together = scorer(poses, batch).fitness
    np.testing.assert_allclose(together[7:9], scorer(poses[7:9], batch[7:9]).fitness, rtol=0, atol=1e-6)


def test_other_numbers_of_candidates_compile_nothing():
    clip, batch = observed(), candidates(1, 6)
    poses = MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, FRAMES)
    scorer = TileScorer(batch.shapes, clip, (4, 9, 2))

    def compiled(count: int) -> int:
        rows = np.zeros(count, int)
        scorer(poses[rows], batch[rows])
        return tiles._chunk._cache_size()

    # One program for each number of tiles that a batch may need.
    known = [compiled(count) for count in (2, 16)][-1]
    assert [compiled(count) for count in (3, 5, 9, 14)] == [known] * 4


@pytest.mark.parametrize(("resolution", "bound"), [((120, 80), 0.03), ((61, 43), 0.06), ((1000, 1000), 1e-5)])
def test_coarse_scores_estimate_the_full_ones(resolution, bound):
    size = (240, 160)
    clip, batch = observed(size), candidates(8, 5)
    poses = MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, FRAMES)
    full = TileScorer(batch.shapes, clip, (4, 9, 2))(poses, batch)
    coarse = TileScorer(batch.shapes, clip, (4, 9, 2), resolution)(poses, batch)
    np.testing.assert_allclose(coarse.iou, full.iou, atol=bound)
    np.testing.assert_allclose(coarse.epe, full.epe, atol=bound * np.maximum(1.0, full.epe.max()))


# Outlines ---------------------------------------------------------------------------------------------------------------


def reach_of_pixels(mask: np.ndarray, count: int) -> np.ndarray:
    rows, columns = np.nonzero(mask)
    return (np.stack([columns + 0.5, rows + 0.5], -1) @ directions(count).T).max(0)


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.sampled_from(["sphere", "box", "cylinder"]))
def test_outlines_against_pixels(seed, shape):
    generator = np.random.default_rng(seed)
    size = {"sphere": 1, "box": 3, "cylinder": 2}[shape]
    extents = tuple(generator.uniform(0.15, 0.6, size).tolist())
    poses, batch = placed(shape, extents, generator.uniform(3.0, 6.0), 0.0, generator.uniform(0, 90))
    poses[..., 3:] = generator.normal(size=4)
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    picture = (300, 300)
    masks, _ = draw(poses[0], batch, picture)
    reach = supports(poses, batch, picture, 16)
    for t in (0, FRAMES - 1):
        mask = masks[t] > 0
        assert mask[[0, -1]].sum() + mask[:, [0, -1]].sum() == 0
        difference = reach[0, t, 0] - reach_of_pixels(mask, 16)
        # The last pixel's centre lies inside, at most a diagonal (at a sharp corner more) before the edge; a circle's
        # polygon falls short of it by up to 0.5 % of its radius.
        assert difference.min() > -0.3
        assert difference.max() < 1.6
        assert np.median(difference) < 0.75


def test_outlines_of_large_objects_are_exact():
    poses, batch = placed("sphere", (1.0,), 4.0)
    focal = 2000 / np.tan(np.deg2rad(25))
    reach = supports(poses[:, :1], batch, (4000, 4000), 16)[0, 0, 0]
    centre = directions(16) @ [2000.0, 2000.0]
    np.testing.assert_allclose(reach - centre, focal / np.sqrt(15), rtol=1e-4)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 33, 129])
def test_outlines_do_not_depend_on_the_batch(count):
    batch = candidates(count, 6)
    poses = MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, 2)
    together = supports(poses, batch, SIZE, 8)
    assert together.shape == (count, 2, 3, 8)
    alone = supports(poses[-1:], batch[count - 1 :], SIZE, 8)
    np.testing.assert_allclose(together[-1:], alone, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("count", [33, 64, 96, 97, 161])
def test_outlines_and_flow_are_the_same_in_pieces(count):
    batch = candidates(count, 6)
    poses = MujocoSimulator(batch.shapes, 30.0, 1).rollout(batch, 2)
    pixels = np.random.default_rng(0).uniform(0, 100, (2, 3, 5, 2))
    parts = [slice(k, k + 32) for k in range(0, count, 32)]
    apart = np.concatenate([supports(poses[rows], batch[rows], SIZE, 8) for rows in parts])
    np.testing.assert_allclose(supports(poses, batch, SIZE, 8), apart, rtol=1e-5, atol=1e-3)
    apart = np.concatenate([point_flow(poses[rows], batch[rows], pixels, SIZE) for rows in parts])
    together = point_flow(poses, batch, pixels, SIZE)
    assert together.shape == (count, 2, 3, 5, 2)
    np.testing.assert_allclose(together, apart, rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("place", [(-3.0, 0.0), (0.0, 1.5), (0.3, 0.2), (1.02, 0.0)])
@pytest.mark.parametrize("shape", ["sphere", "box", "cylinder"])
def test_outlines_are_finite_around_the_camera(shape, place):
    size = {"sphere": (1.0,), "box": (0.5, 0.6, 0.5), "cylinder": (1.0, 0.5)}[shape]
    poses, batch = placed(shape, size, *place)
    assert np.isfinite(supports(poses, batch, SIZE, 16)).all()
