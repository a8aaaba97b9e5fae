"""Whether a scene is a clip's: objects overlap their own masks."""

from __future__ import annotations

import dataclasses

import pytest
from test_diagnosis import BALL, CAMERA, clip_of

from mjx_refine.diagnosis.diagnose import LEAST_IOU, prepared
from mjx_refine.errors import InputError
from mjx_refine.scene import Samples, Scene
from mjx_refine.search.options import Options
from mjx_refine.search.problem import Problem

LEFT, RIGHT = (
    dataclasses.replace(BALL, name=name, position=(x, 0.3, 0.9)) for name, x in (("left", -0.9), ("right", 0.4))
)
SCENE = Scene((LEFT, RIGHT), CAMERA, (0.0, 0.0, -9.81))
OFF = dataclasses.replace(SCENE, objects=(dataclasses.replace(LEFT, position=(-0.67, 0.3, 0.9)), RIGHT))
"""One of its objects is off by more than its radius."""


def test_a_scene_whose_objects_all_have_masks_is_the_clips():
    _, start, _ = prepared(OFF, clip_of(SCENE, 12), 1)
    assert start.matching == (1, 2)


def test_an_object_without_a_mask_overlaps_nothing():
    """What objects cover together may overlap another clip's masks by more than is asked."""
    clip = clip_of(dataclasses.replace(SCENE, objects=(LEFT,)), 12)
    (start,) = Problem(Samples("given", (OFF,), (0,)), clip, Options(threads=1)).starts
    assert float(start.scores.iou[0]) > LEAST_IOU
    with pytest.raises(InputError, match="overlaps the clip"):
        prepared(OFF, clip, 1)


def test_a_scene_that_lies_on_a_clip_may_have_an_object_without_a_mask():
    clip = clip_of(dataclasses.replace(SCENE, objects=(LEFT,)), 12)
    _, start, _ = prepared(SCENE, clip, 1)
    assert sorted(start.matching)[-1] == 1


def test_without_masks_what_moves_tells():
    clip = dataclasses.replace(clip_of(SCENE, 12), masks=None)
    prepared(SCENE, clip, 1)
