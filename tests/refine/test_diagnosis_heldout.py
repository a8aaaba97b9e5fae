"""The gap on frames that no fit has seen."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagnosis import FLIGHT, clip_of
from test_diagnosis_replay import started

from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.misfit.heldout import held_out, kept_frames
from mjx_refine.diagnosis.seen.common_motion import FEW, affine, similar
from mjx_refine.scene import Effect
from mjx_refine.space import Space

GRID = np.stack(np.meshgrid(np.arange(12.0), np.arange(9.0)), -1).reshape(-1, 2) * 20 + 50


@pytest.mark.parametrize("matrix", [[[0, -1], [1, 0]], [[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]]])
def test_what_flow_has_in_common_is_a_similarity_or_an_affine_function(matrix):
    """Turns and stretches are similarities, shears are affine only."""
    flow = (GRID - GRID.mean(0)) @ np.array(matrix).T / 20 + [3.0, -2.0]
    square, shift = float((flow**2).sum()), 13.0 * len(GRID)
    assert affine(flow, GRID) == pytest.approx(square)
    sheared = matrix[0][0] != matrix[1][1] or matrix[0][1] != -matrix[1][0]
    assert similar(flow, GRID) == pytest.approx(shift if sheared else square, abs=0.3 * (square - shift))


def test_noise_has_nothing_in_common_and_few_places_do_not_tell():
    draws = np.random.default_rng(0).normal(size=(200, *GRID.shape))
    assert np.mean([affine(flow, GRID) for flow in draws]) < 6
    assert np.mean([similar(flow, GRID) for flow in draws]) < 4
    assert affine(np.ones((FEW - 1, 2)), GRID[: FEW - 1]) == 0.0
    assert similar(np.zeros((0, 2)), GRID[:0]) == 0.0


def test_what_flow_invents_is_no_gap():
    """A drag closes the same part of the gap whether or not the background's flow is wild in three held-out frames."""
    dragged = dataclasses.replace(FLIGHT, effects=(Effect("drag", FLIGHT.names[0], (("quadratic", 0.1),)),))
    _, start, clip = started(FLIGHT, clip_of(dragged))
    base = Hypothesis(Space.around(start.scene))
    plain = clip.fit(base, np.zeros(base.dimension), 10)
    one = base.added(term("drag", 0, clip.frames))
    best = clip.fit(one, np.zeros(one.dimension), 10)
    quiet = held_out(clip, plain, best)
    assert quiet.closed > 0.8
    background = clip.measured.background.copy()
    wild = np.nonzero(~kept_frames(clip.frames))[0][:3]
    background[wild, ::7] += np.random.default_rng(1).choice([-4.0, 4.0], background[wild, ::7].shape)
    clip.measured = dataclasses.replace(clip.measured, background=background)
    loud = held_out(clip, clip.at(base, plain.z), clip.at(one, best.z))
    assert loud.closed == pytest.approx(quiet.closed, abs=0.05)
    assert loud.closed_of_all < quiet.closed_of_all - 0.2
    assert loud.gain == pytest.approx(quiet.gain, rel=0.05)


def test_a_camera_that_moves_is_a_gap():
    """What the background moves by as one is the simulation's to explain."""
    _, start, clip = started(FLIGHT, clip_of(FLIGHT))
    base = Hypothesis(Space.around(start.scene))
    fit = clip.at(base, np.zeros(base.dimension))
    still = held_out(clip, fit, None)
    moving = clip.measured.background + np.array([0.6, -0.4])
    clip.measured = dataclasses.replace(clip.measured, background=moving)
    moved = held_out(clip, clip.at(base, fit.z), None)
    assert np.mean(moved.before**2) > np.mean(still.before**2) + 1.0
