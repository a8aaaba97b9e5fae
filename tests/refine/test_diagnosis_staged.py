"""Least squares over ever more of a clip."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from own_clip import CAMERA
from test_diagnosis import clip_of
from test_diagnosis_replay import started

from mjx_refine.diagnosis.fits.base import base_space
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.staged import staged
from mjx_refine.diagnosis.search.tempered import WARM, tempered
from mjx_refine.scene import Body, Scene

STRUCK = Scene(
    (
        Body("box", "box", (0.2, 0.15, 0.2), (-0.7, 0.5, 0.2), linear_velocity=(2.4, 0.2, 0.0)),
        Body("sphere", "ball", (0.22,), (0.1, 0.62, 0.22)),
    ),
    CAMERA,
    (0.0, 0.0, -9.81),
)


@pytest.fixture(scope="module")
def struck():
    """Residuals of a clip in which a box strikes a ball, from a scene in which it comes later and meets it elsewhere."""
    box, ball = STRUCK.objects
    late = dataclasses.replace(box, linear_velocity=(2.0, 0.05, 0.0))
    _, start, clip = started(dataclasses.replace(STRUCK, objects=(late, ball)), clip_of(STRUCK, 24))
    return clip, Hypothesis(base_space(start.scene))


def test_what_bodies_meet_late_is_fitted_from_the_first_frames(struck):
    clip, plain = struck
    zero = np.zeros(plain.dimension)
    with tempered(clip, WARM):
        by_stages, at_once = staged(clip, plain, zero), clip.fit(plain, zero, 10)
    assert by_stages.cost < 0.8 * at_once.cost


def test_frames_that_are_not_kept_are_not_simulated(struck):
    clip, plain = struck
    z = 0.1 * np.ones((3, plain.dimension))
    keep = np.arange(clip.frames) < 6
    before = clip.rollouts
    told = clip.poses(plain, z, keep)
    assert clip.rollouts - before == pytest.approx(3 * 7 / clip.frames)
    whole = clip.poses(plain, z)
    assert told.shape == whole.shape
    np.testing.assert_array_equal(told[:, :7], whole[:, :7])
    np.testing.assert_array_equal(told[:, 7:], np.repeat(told[:, 6:7], clip.frames - 7, 1))
    (short, cost), scale = clip.residuals(plain, z, keep), 5.0
    white = clip.whitened(clip.distances(clip.predictor(whole, plain.batch(z))), keep, scale, plain)
    np.testing.assert_allclose(short, white, atol=1e-6)
    assert np.isfinite(cost).all()
