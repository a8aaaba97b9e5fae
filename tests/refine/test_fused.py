"""The kernel that makes all steps of a candidate, on whatever device there is, against C MuJoCo."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

pytest.importorskip("warp")

from benchmarks.speed_scenes import KINDS, near
from mjx_refine.effects import batch_with_effects
from mjx_refine.errors import InputError
from mjx_refine.scene import Body, Effect, Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.fused import LARGEST
from mjx_refine.sim.fused.kernel import CONVEX, LANES
from mjx_refine.sim.fused.simulator import FusedSimulator, packed, plan
from mjx_refine.sim.model import contact_pairs
from mjx_refine.sim.warp import contact_points

CAMERA = KINDS["sphere"].camera
BALL, CRATE, DRUM, BRICK = (b for b in KINDS["four mixed"].objects)


def moved(body: Body, name: str, position: tuple[float, float, float], velocity: float = 0.0) -> Body:
    return dataclasses.replace(body, name=name, position=position, linear_velocity=(velocity, 0.0, 0.0))


SCENES = {
    **KINDS,
    "cylinders": Scene((moved(DRUM, "a", (-0.3, 0.5, 0.2), 0.8), moved(DRUM, "b", (0.3, 0.6, 0.4))), CAMERA),
    "boxes": Scene((moved(CRATE, "a", (-0.3, 0.6, 0.15)), moved(CRATE, "b", (0.4, 0.6, 0.3), -1.0)), CAMERA),
    "sphere+cylinder": Scene((moved(BALL, "a", (-0.6, 0.6, 0.3), 1.0), moved(DRUM, "b", (0.3, 0.6, 0.3))), CAMERA),
    "sphere+box": Scene((moved(BALL, "a", (-0.6, 0.6, 0.3), 1.0), moved(CRATE, "b", (0.3, 0.6, 0.3))), CAMERA),
    "spheres": Scene((moved(BALL, "a", (-0.5, 0.6, 0.3), 1.0), moved(BALL, "b", (0.2, 0.6, 0.3))), CAMERA),
}


def candidates(name: str, count: int = 32):
    return batch_with_effects([near(SCENES[name], k, 0.3) for k in range(count)])


def made(batch) -> FusedSimulator:
    return FusedSimulator(batch.shapes, 30.0, any_device=True)


def apart(first: np.ndarray, second: np.ndarray, frame: int) -> np.ndarray:
    return np.linalg.norm(first[:, frame, :, :3] - second[:, frame, :, :3], axis=-1)


@pytest.mark.parametrize("name", SCENES)
def test_rollouts_are_those_of_c_mujoco(name):
    """The same until contacts make them chaotic, then as near as MJX-Warp's in a search (``QUICK``), or as C is to itself from a
    micrometre beside."""
    batch = candidates(name)
    reference = MujocoSimulator(batch.shapes, 30.0)
    own, c = made(batch).rollout(batch, 30), reference.rollout(batch, 30)
    beside = batch.map(np.copy)
    beside.position[:] += 1e-6 * np.random.default_rng(0).normal(size=beside.position.shape)
    spread = np.quantile(apart(reference.rollout(beside, 30), c, 18), 0.9)
    assert np.isfinite(own).all()
    np.testing.assert_allclose(own[:, 0], c[:, 0], atol=1e-6)
    assert np.median(apart(own, c, 5)) < 2e-5
    assert apart(own, c, 5).max() < 8e-3
    assert np.median(apart(own, c, 18)) < 3e-3
    assert np.quantile(apart(own, c, 18), 0.9) < max(11e-3, 1.5 * spread)
    assert np.median(apart(own, c, 29)) < 6e-3


def test_a_rollout_is_the_same_twice_and_leaves_nothing_behind():
    batch = candidates("box+cylinder", 4)
    simulator = made(batch)
    before = simulator.rollout(batch, 8)
    wild = batch.map(np.copy)
    wild.linear_velocity[1] = np.nan
    broken = simulator.rollout(wild, 8)
    assert np.isnan(broken[1, 1:]).all()
    np.testing.assert_array_equal(broken[[0, 2, 3]], before[[0, 2, 3]])
    np.testing.assert_array_equal(simulator.rollout(batch, 8), before)


def test_rollouts_that_overlap_in_time_do_not_mix():
    batch = candidates("box+cylinder", 8)
    simulator = made(batch)
    halves = [batch[slice(0, 4)], batch[slice(4, 8)]]
    alone = [simulator.rollout(half, 5) for half in halves]
    for poses, expected in zip([wait() for wait in [simulator.launch(half, 5) for half in halves]], alone, strict=True):
        np.testing.assert_array_equal(np.asarray(poses)[:4], expected.astype(np.float32))


def test_rows_beyond_a_batch_repeat_its_last_candidate():
    batch = candidates("sphere", 5)
    poses = np.asarray(made(batch).launch(batch, 3)())
    assert len(poses) == 16
    np.testing.assert_array_equal(poses[5:], np.repeat(poses[4:5], 11, 0))


def test_every_pair_has_a_row_and_as_many_points_as_mujoco_has_at_most():
    for name, scene in SCENES.items():
        rows, points = plan(scene.shapes)
        assert len(rows) == len(contact_pairs(len(scene.shapes))), name
        together = [row for row in rows if row[0] >= 0]
        assert {tuple(sorted(row[:2])) for row in together} == {
            pair for pair in contact_pairs(len(scene.shapes)) if pair[0] >= 0
        }
        assert points <= contact_points(scene.shapes)
    assert {int(k) for k in plan(SCENES["cylinders"].shapes)[0][:, 2]} >= {CONVEX["CYLINDERS"]}


def test_a_candidate_is_packed_into_gravity_bodies_and_pairs():
    batch = candidates("four mixed", 3)
    numbers = packed(batch)
    assert numbers.shape == (3, 3 + 4 * 21 + 10 * 6)
    np.testing.assert_allclose(numbers[:, :3], batch.gravity)
    np.testing.assert_allclose(numbers[:, 3 + 21 : 3 + 24], batch.size[:, 1], rtol=1e-6)


def test_effects_on_floor_and_timing_are_carried():
    slope = Effect("slope", None, (("x", 0.05), ("y", 0.03)))
    scenes = [dataclasses.replace(near(KINDS["sphere"], k, 0.2), effects=(slope,)) for k in range(3)]
    batch = batch_with_effects(scenes)
    own, c = made(batch).rollout(batch, 8), MujocoSimulator(batch.shapes, 30.0).rollout(batch, 8)
    np.testing.assert_allclose(own, c, atol=2e-5)


def test_more_objects_than_a_block_has_memory_for_are_refused():
    shapes = ("sphere",) * (LARGEST + 1)
    with pytest.raises(InputError, match=f"{LARGEST + 1} objects; one kernel holds up to {LARGEST}"):
        FusedSimulator(shapes, 30.0, any_device=True)


@pytest.mark.gpu
@pytest.mark.parametrize("name", KINDS)
def test_a_warp_of_a_gpu_finds_what_c_mujoco_finds(name):
    batch = candidates(name)
    simulator = made(batch)
    own, c = simulator.rollout(batch, 13), MujocoSimulator(batch.shapes, 30.0).rollout(batch, 13)
    assert simulator._lanes == LANES
    assert np.median(apart(own, c, 5)) < 2e-5
    assert np.median(apart(own, c, 12)) < 3e-3
    np.testing.assert_array_equal(simulator.rollout(batch, 13), own)
