"""Starting samples from an observation alone, on clips made by the simulator itself."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjx_refine.batch import batch_from_scenes
from mjx_refine.errors import InputError
from mjx_refine.guess import guess_scenes
from mjx_refine.guess.lift import Lens, fit_forms, fly, onto_plane
from mjx_refine.guess.tracks import cut, find_tracks
from mjx_refine.observation import Observation, make_observation
from mjx_refine.scene import Body, Camera, Scene, dump_scene, parse_scenes
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view.picture import draw
from mjx_refine.view.tiles import TileScorer

SIZE, FPS = (160, 120), 30.0


def observed(scene: Scene, frames: int, masks: bool = True) -> Observation:
    batch = batch_from_scenes([scene])
    poses = MujocoSimulator(batch.shapes, FPS).rollout(batch, frames)
    drawn, flow = draw(poses[0], batch, SIZE)
    return make_observation(flow, FPS, drawn if masks else None)


def iou(scene: Scene, observation: Observation, matching: tuple[int, ...]) -> float:
    batch = batch_from_scenes([scene])
    poses = MujocoSimulator(batch.shapes, FPS).rollout(batch, observation.length)
    return float(TileScorer(batch.shapes, observation, matching)(poses, batch).iou[0])


def ball(**changes) -> Body:
    body = Body("sphere", "ball", (0.12,), (-0.9, 0.0, 0.8), linear_velocity=(2.2, 0.0, 2.5))
    return dataclasses.replace(body, **changes)


@pytest.fixture(scope="module")
def flight() -> tuple[Scene, Observation]:
    scene = Scene((ball(),), Camera((0.0, -4.0, 1.0), 90.0))
    return scene, observed(scene, 16)


@pytest.fixture(scope="module")
def flight_guesses(flight) -> list[Scene]:
    return guess_scenes(flight[1])


@pytest.fixture(scope="module")
def pucks() -> tuple[Scene, Observation]:
    puck = Body("cylinder", "a", (0.2, 0.12), (-1.2, 0.1, 0.06), linear_velocity=(3.0, 0.0, 0.0), friction=(0.15, 0.0))
    other = dataclasses.replace(puck, name="b", position=(0.9, -0.6, 0.06), linear_velocity=(-0.5, 1.0, 0.0))
    scene = Scene((puck, other), Camera((0.0, 0.0, 4.0), 0.0))
    return scene, observed(scene, 12)


def test_a_thrown_ball(flight, flight_guesses):
    _, observation = flight
    assert len(flight_guesses) == 32
    assert iou(flight_guesses[0], observation, (1,)) > 0.6
    # Gravity gives the scale: some sample with 9.81 m/s^2 has the ball's true size and distance.
    true_size = [s for s in flight_guesses if np.isclose(np.linalg.norm(s.gravity), 9.81, rtol=1e-6)]
    assert true_size
    best = min(true_size, key=lambda s: abs(np.log(s.objects[0].size[0] / 0.12)))
    assert best.objects[0].size[0] == pytest.approx(0.12, rel=0.25)
    assert -best.camera.position[1] + best.objects[0].position[1] == pytest.approx(4.0, rel=0.25)


def test_samples_differ_and_can_be_written(flight_guesses):
    texts = {dump_scene(s) for s in flight_guesses}
    assert len(texts) == 32
    assert len({round(s.camera.orientation / 10) for s in flight_guesses}) >= 3
    again = parse_scenes("---\n".join(dump_scene(s) for s in flight_guesses))
    assert list(again.scenes) == flight_guesses


def test_two_pucks_from_above(pucks):
    scene, observation = pucks
    guesses = guess_scenes(observation)
    best = guesses[0]
    assert iou(best, observation, (1, 2)) > 0.6
    # Places and speeds in units of the camera's height, which nothing in the clip tells.
    found = np.array([b.position[:2] for b in best.objects]) - best.camera.position[:2]
    if best.camera.orientation < 5:
        true = np.array([b.position[:2] for b in scene.objects])
        assert np.abs(found / best.camera.position[2] - true / 4.0).max() < 0.05
    assert any(s.camera.orientation < 5 for s in guesses)


def test_same_seed_same_samples():
    observation = observed(Scene((ball(),), Camera((0.0, -4.0, 1.0), 90.0)), 6)
    first, second = (guess_scenes(observation, 12, seed=3) for _ in range(2))
    assert first == second
    assert len(first) == 12


def test_without_masks(flight):
    scene, with_masks = flight
    observation = observed(scene, 16, masks=False)
    tracks, _ = find_tracks(observation)
    assert len(tracks) == 1
    assert iou(guess_scenes(observation, 8)[0], with_masks, (1,)) > 0.4


def test_two_frames(flight):
    observation = flight[1]
    assert observation.masks is not None
    short = make_observation(observation.flow[:1], FPS, observation.masks[:2])
    guesses = guess_scenes(short, 5)
    assert len(guesses) == 5
    assert iou(guesses[0], short, (1,)) > 0.5


def test_an_object_that_enters_late():
    scene = Scene(
        (Body("sphere", "s", (0.2,), (-2.6, 0.0, 0.2), linear_velocity=(3.0, 0.0, 0.0), friction=(0.0, 0.0)),),
        Camera((0.0, 0.0, 4.0), 0.0),
    )
    observation = observed(scene, 30)
    assert observation.masks is not None
    assert not observation.masks[0].any()
    best = guess_scenes(observation)[0]
    assert best.objects[0].position[0] / best.camera.position[2] < -0.5
    assert iou(best, observation, (1,)) > 0.5


def test_tiny_masks_and_masks_at_the_border():
    masks = np.zeros((4, 60, 80), np.int32)
    for t in range(4):
        masks[t, 20:23, 5 * t : 5 * t + 3] = 7
        masks[t, 40:, 60:] = 9
    flow = np.zeros((3, 60, 80, 2), np.float32)
    flow[masks[:-1] == 7] = (5.0, 0.0)
    guesses = guess_scenes(make_observation(flow, 30.0, masks), 6)
    assert len(guesses) == 6
    assert all(len(s.objects) == 2 for s in guesses)


def test_nothing_there():
    with pytest.raises(InputError, match="no object was found"):
        guess_scenes(make_observation(np.zeros((4, 60, 80, 2), np.float32), 30.0))
    with pytest.raises(InputError, match="count = 0"):
        guess_scenes(make_observation(np.zeros((4, 60, 80, 2), np.float32), 30.0), 0)


def test_flight_is_recovered_from_its_projection():
    lens = Lens(np.deg2rad(60.0), np.deg2rad(45.0), (320, 240))
    gravity = np.array([0.0, 0.0, -9.81])
    place, speed, t = np.array([-0.5, 2.5, -1.0]), np.array([1.0, 0.6, 2.0]), np.arange(12) / 30.0
    points = place + speed * t[:, None] + gravity * t[:, None] ** 2 / 2
    camera = points @ lens.matrix
    depth = -camera[:, 2]
    pixel = np.stack([camera[:, 0], -camera[:, 1]], -1) / depth[:, None] * lens.focal + np.array([160.0, 120.0])
    flight = fly(lens, pixel, t, 0.2 * lens.focal / depth, gravity, trust=0.5)
    assert flight is not None
    np.testing.assert_allclose(flight.position, place, atol=0.02)
    np.testing.assert_allclose(flight.velocity, speed, atol=0.05)


def test_floor_points_project_back():
    lens = Lens(np.deg2rad(40.0), np.deg2rad(50.0), (320, 240))
    pixel = np.array([[160.0, 120.0], [40.0, 200.0]])
    points = onto_plane(lens, pixel, 2.0)
    assert points is not None
    np.testing.assert_allclose(points[:, 2], -2.0)
    camera = points @ lens.matrix
    again = np.stack([camera[:, 0], -camera[:, 1]], -1) / -camera[:, 2:] * lens.focal + np.array([160.0, 120.0])
    np.testing.assert_allclose(again, pixel, atol=1e-9)
    assert onto_plane(Lens(np.deg2rad(90.0), 0.8, (320, 240)), np.array([[160.0, 20.0]]), 1.0) is None


def test_a_box_from_above_has_its_sides_and_turn():
    angle = 2 * np.pi * np.arange(8) / 16
    turn = np.deg2rad(30.0)
    # Picture directions have y down: a box turned by +30 degrees in the world is turned the other way there.
    widths = 2 * (20 * np.abs(np.cos(angle + turn)) + 10 * np.abs(np.sin(angle + turn)))
    lens = Lens(0.0, 0.8, (320, 240))
    best = fit_forms(lens, np.array([0.0, 0.0, -1.0]), widths, "box")[0]
    assert best.size[:2] == pytest.approx((20.0, 10.0), rel=0.03)
    assert 2 * np.arctan2(best.quaternion[3], best.quaternion[0]) == pytest.approx(turn, abs=1e-6)


def test_a_track_is_cut_where_it_breaks():
    t = np.arange(20)
    x = np.where(t < 9, 5.0 * t, 45.0 - 3.0 * (t - 9))
    pieces = cut(t, np.stack([x, np.full(20, 7.0)], -1), 1.5)
    assert len(pieces) == 2
    assert pieces[0].frames[-1] in (8, 9)
    np.testing.assert_allclose(pieces[0].velocity, [5.0, 0.0], atol=0.1)
    np.testing.assert_allclose(pieces[1].velocity, [-3.0, 0.0], atol=0.1)
