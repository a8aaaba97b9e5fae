"""Scenes as arrays and back."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjx_refine.batch import batch_from_scenes, concatenate, scene_from_batch
from mjx_refine.scene import Body, Camera, Effect, Scene

SPHERE = Body("sphere", "ball", (0.2,), (0.0, 1.0, 0.2), friction=(0.3, 0.02), mass=2.0, damping=-9.0)
BOX = Body("box", "crate", (0.1, 0.2, 0.3), (1.0, 0.0, 0.3), (0.6, 0.8, 0.0, 0.0), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
CYLINDER = Body("cylinder", "can", (0.1, 0.5), (2.0, 0.0, 0.25), stiffness=8000.0)
SCENE = Scene(
    (SPHERE, BOX, CYLINDER), Camera((0.0, -2.0, 3.5), 45.0, 50.0), (0.1, 0.0, -7.0), (Effect("drag", "ball"),)
)


def test_a_scene_survives_the_arrays():
    back = scene_from_batch(batch_from_scenes([SCENE]), 0, SCENE)
    assert back.camera.orientation == pytest.approx(45.0, rel=1e-14)
    assert dataclasses.replace(back, camera=SCENE.camera) == SCENE


def test_sizes_are_mujocos():
    batch = batch_from_scenes([SCENE])
    np.testing.assert_array_equal(batch.size[0], [[0.2, 0, 0], [0.1, 0.2, 0.3], [0.1, 0.25, 0]])


def test_rows_and_concatenation():
    other = dataclasses.replace(SCENE, gravity=(0.0, 0.0, -1.0))
    batch = batch_from_scenes([SCENE, other])
    assert len(batch) == 2
    again = concatenate([batch[0:1], batch[np.array([1])]])
    for field in dataclasses.fields(batch):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(batch, field.name))
    assert scene_from_batch(batch, 1, SCENE).gravity == (0.0, 0.0, -1.0)


@pytest.mark.parametrize("objects", [(SPHERE, CYLINDER, BOX), (SPHERE,)], ids=["other shapes", "fewer objects"])
def test_scenes_of_different_kinds_make_no_batch(objects):
    other = dataclasses.replace(SCENE, objects=objects)
    with pytest.raises(ValueError, match="kind"):
        batch_from_scenes([SCENE, other])
    with pytest.raises(ValueError, match="kind"):
        concatenate([batch_from_scenes([SCENE]), batch_from_scenes([other])])


def test_no_scene_makes_no_batch():
    with pytest.raises(ValueError, match="scene"):
        batch_from_scenes([])
    with pytest.raises(ValueError, match="kind"):
        concatenate([])
