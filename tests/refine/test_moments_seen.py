"""Centroids and areas of whole masks as evidence, what is taken for noise, and what contacts are forgiven."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from effect_scenes import effect
from own_clip import FLIGHT, OwnClip

from mjx_refine.batch import SceneBatch
from mjx_refine.diagnosis.fits.slack import slack_of, sustained, touching
from mjx_refine.diagnosis.seen.measure import Parts, measure
from mjx_refine.diagnosis.seen.noise import MORE_THAN_ROUGH, Counts, everywhere, settled
from mjx_refine.diagnosis.seen.predict import Predictor
from mjx_refine.effects import batch_with_effects
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view.effects import draw_effects
from mjx_refine.view.moments import whole_masks
from mjx_refine.view.seen import polygon_sums

FPS = 30.0
SIZE = (480, 320)
SCENE = Scene(
    (
        Body("sphere", "ball", (0.25,), (-0.6, 0.3, 0.8), (1.0, 0.0, 0.0, 0.0), (2.5, 0.0, 1.0), (0.0, 3.0, 0.0)),
        Body("box", "crate", (0.3, 0.2, 0.2), (0.7, 0.2, 0.2), linear_velocity=(-2.0, 0.5, 0.0)),
    ),
    Camera((0.2, -3.0, 2.0), 60.0, 45.0),
)


def seen_moments(poses: np.ndarray, batch: SceneBatch) -> np.ndarray:
    """Centroids and equivalent radii as a diagnosis predicts them."""
    nowhere = np.zeros((poses.shape[1], 2, 1, 2))
    return Predictor(batch.shapes, nowhere, np.zeros((1, 2)), SIZE, FPS)(poses, batch).moments


def test_many_candidates_are_predicted_a_batch_at_a_time():
    scenes = [
        dataclasses.replace(SCENE, camera=dataclasses.replace(SCENE.camera, fovy=40.0 + k / 8)) for k in range(60)
    ]
    batch = batch_with_effects(scenes)
    poses = MujocoSimulator(batch.shapes, FPS, 1).rollout(batch, 4)
    together = seen_moments(poses, batch)
    assert together.shape == (60, 4, 2, 3)
    for row in (0, 47, 48, 59):
        np.testing.assert_allclose(
            together[row], seen_moments(poses[row : row + 1], batch[row : row + 1])[0], atol=1e-3
        )
    assert np.ptp(together[:, 0, 0, 2]) > 1.0


SEEN = (
    effect("camera_motion", pan=20.0, x=0.4),
    effect("lens_distortion", k1=0.25),
    effect("rolling_shutter", readout=0.015),
    effect("mask_bias", width=3.0),
    effect("mask_bias", width=-5.0),
    effect("occluder", left=170.0, top=60.0, right=200.0, bottom=200.0),
)


@pytest.mark.parametrize("entry", SEEN, ids=lambda e: f"{e.effect} {e.parameters[0][1]:g}")
def test_centroids_and_areas_are_those_of_the_pictures(entry):
    batch = batch_with_effects([dataclasses.replace(SCENE, effects=(entry,))])
    poses = MujocoSimulator(batch.shapes, FPS, 1).rollout(batch, 4)
    masks, _ = draw_effects(poses[0], batch, SIZE, FPS)
    told, drawn = seen_moments(poses, batch)[0], whole_masks(masks, (1, 2))
    assert np.isfinite(drawn[:3]).all()
    off = np.abs(told - drawn)[:3]
    assert off[..., :2].max() < 0.3
    assert off[..., 2].max() < 0.3


def test_fat_masks_show_what_stands_still_beside_an_object():
    plain = batch_with_effects([SCENE])
    poses = MujocoSimulator(plain.shapes, FPS, 1).rollout(plain, 3)
    x, y, radius = seen_moments(poses, plain)[0, 0, 0]
    # In the ball's middle, then one and five pixels beside it.
    pixels = np.zeros((3, 2, 3, 2))
    pixels[:, 0] = [[x, y], [x - radius - 1.0, y], [x - radius - 5.0, y]]

    def flow(width: float, blur: float = 0.0) -> np.ndarray:
        batch = batch_with_effects([dataclasses.replace(SCENE, effects=(effect("mask_bias", width=width),))])
        told = Predictor(batch.shapes, pixels, np.array([[20.0, 20.0]]), SIZE, FPS, blur)(poses, batch)
        return np.linalg.norm(told.flow[0, 0, 0], axis=-1)

    still, fat, smeared = flow(0.0), flow(6.0), flow(6.0, 2.0)
    assert still.min() > 5.0
    np.testing.assert_allclose(fat / still, [1.0, 0.0, 0.0], atol=0.2)
    np.testing.assert_allclose(smeared / still, [1.0, 1.0, 0.0], atol=0.2)
    # Thin masks show nothing but the object.
    np.testing.assert_allclose(flow(-3.0), still)


def test_an_occluder_moves_what_is_left_of_a_mask():
    plain = batch_with_effects([SCENE])
    poses = MujocoSimulator(plain.shapes, FPS, 1).rollout(plain, 2)
    whole = seen_moments(poses, plain)[0, 0, 0]
    half = effect("occluder", left=whole[0], top=0, right=480, bottom=320)
    hidden = batch_with_effects([dataclasses.replace(SCENE, effects=(half,))])
    left = seen_moments(poses, hidden)[0, 0, 0]
    # The centroid of a half disc lies 4 r / (3 pi) beside its diameter; the polygon has sixteen corners.
    np.testing.assert_allclose(left[2], whole[2] / np.sqrt(2), rtol=0.01)
    np.testing.assert_allclose(whole[0] - left[0], 4 * whole[2] / (3 * np.pi), rtol=0.05)
    everything = effect("occluder", left=0, top=0, right=480, bottom=320)
    gone = batch_with_effects([dataclasses.replace(SCENE, effects=(everything,))])
    assert np.isnan(seen_moments(poses, gone)).all()


def test_sums_of_a_rectangle():
    corners = np.array([[1.0, 2.0], [4.0, 2.0], [4.0, 7.0], [1.0, 7.0]])
    np.testing.assert_allclose(polygon_sums(corners), [15.0, 15.0 * 2.5, 15.0 * 4.5])


# Noise ------------------------------------------------------------------------------------------------------------------


def _measured():
    clip = OwnClip(FLIGHT, 12)
    return measure(Observation(clip.flow, clip.masks, 30.0), (0,))


def test_parts_come_back_from_a_row():
    measured = _measured()
    parts = Parts(*(np.random.default_rng(0).normal(size=(1, *p.shape)) for p in measured.parts))
    for part, back in zip(parts, measured.split(parts.flat()[0]), strict=True):
        np.testing.assert_array_equal(part[0], back)


@pytest.mark.parametrize("size", [0.8, 2.0])
def test_noise_settles_at_what_changes_from_frame_to_frame(size):
    measured, counts, rng = _measured(), Counts(), np.random.default_rng(1)
    noise, weight = everywhere(measured, 12), counts.of(measured.parts)
    smooth = 5.0 * np.linspace(0, 1, 12)[:, None, None] ** 2
    residual = Parts(
        *(
            np.sqrt(count) * size * rng.normal(size=part.shape)
            for part, count in zip(measured.parts, weight, strict=True)
        )
    )
    residual = residual._replace(moments=residual.moments + smooth)
    told, _ = settled(measured, residual, counts)
    np.testing.assert_allclose(told.moment_noise / noise.moments[0], size, rtol=0.5)


def test_a_large_misfit_that_bends_little_is_no_noise():
    measured, counts, rng = _measured(), Counts(), np.random.default_rng(1)
    misfit = 8.0 * np.arange(12)[:, None, None]
    residual = Parts(*(rng.normal(size=part.shape) for part in measured.parts))
    residual = residual._replace(moments=residual.moments + misfit)
    noise = [settled(measured, residual, counts, order)[0].moment_noise / measured.moment_noise for order in (1, 2)]
    np.testing.assert_allclose(noise[0], MORE_THAN_ROUGH)  # as far as third differences let it rise
    np.testing.assert_allclose(noise[1], 1.0, rtol=0.5)


def test_masks_that_another_comes_near_may_be_cut_by_it():
    masks = np.zeros((10, 60, 80), np.uint8)
    masks[:, 20:40, 10:30] = 1
    masks[:, 20:40, 36:56] = 2
    observation = Observation(np.zeros((9, 60, 80, 2), np.float32), masks, 30.0)
    apart, near = measure(observation, (0, 1)), measure(observation, (0, 1), near=8)
    assert np.isfinite(apart.reach).all()
    # The right of the first and the left of the second.
    assert np.isnan(near.reach[:, 0, 0]).all()
    assert np.isnan(near.reach[:, 1, 8]).all()
    assert np.isfinite(near.reach[:, 0, 8]).all()
    assert np.isnan(near.whole).all()
    narrower = apart.without_what_lacks(near)
    assert np.isnan(narrower.moments).all()
    assert narrower.count == near.count - np.isfinite(near.moments).sum() < apart.count
    np.testing.assert_array_equal(narrower.edge_noise, apart.edge_noise)


def test_masks_that_stand_still_say_little():
    clip = OwnClip(FLIGHT, 12)
    still = Observation(np.zeros_like(clip.flow), np.repeat(clip.masks[:1], 12, 0), 30.0)
    assert measure(still, (0,)).freshness.max() <= 0.1
    assert measure(Observation(clip.flow, clip.masks, 30.0), (0,)).freshness.min() == 1.0


# Slack ------------------------------------------------------------------------------------------------------------------


def test_slack_forgives_its_own_columns_and_nothing_else():
    rng = np.random.default_rng(2)
    column, other = rng.normal(size=(2, 60))
    other -= column * (column @ other) / (column @ column)
    slack = slack_of(30.0 * column[:, None] / np.linalg.norm(column))
    forgiven, kept = slack(np.stack([column, other]))
    assert np.linalg.norm(forgiven) < 0.05 * np.linalg.norm(column)
    np.testing.assert_allclose(kept, other, atol=1e-9)
    nothing = slack_of(0.1 * column[:, None] / np.linalg.norm(column))
    np.testing.assert_array_equal(nothing(column[None])[0], column)


def test_times_on_the_floor_may_err():
    slide = Scene(
        (Body("box", "crate", (0.3, 0.2, 0.2), (0.0, 0.0, 0.2), linear_velocity=(2.0, 0.0, 0.0)),), SCENE.camera
    )
    flight = dataclasses.replace(slide, objects=(dataclasses.replace(slide.objects[0], position=(0.0, 0.0, 9.0)),))
    found = []
    for scene in (slide, flight):
        batch = batch_with_effects([scene])
        poses = MujocoSimulator(batch.shapes, FPS, 1).rollout(batch, 20)[0]
        found.append(sustained(batch, poses, touching(batch, poses), FPS))
    assert [i.target for i in found[0]] == [0, 0, 0]
    assert found[1] == []
