"""Fits of what ordinary parameters imitate begin with much of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagnosis import FLIGHT, clip_of

from mjx_refine.diagnosis.diagnose import prepared
from mjx_refine.diagnosis.fits.base import base_space
from mjx_refine.diagnosis.fits.fit import SCALE, ClipFit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.shown import view_of
from mjx_refine.diagnosis.search.leads import beginning
from mjx_refine.diagnosis.search.screen import AWAY, Screen
from mjx_refine.diagnosis.search.singles import _keep_leads
from mjx_refine.effects import catalogue
from mjx_refine.scene import Effect

ANGLE = 7.0


@pytest.fixture(scope="module")
def rolled():
    """Clip, base model's fit and the leads of a flight that a rolled camera filmed."""
    scene = dataclasses.replace(FLIGHT, effects=(Effect("camera_roll", None, (("angle", ANGLE),)),))
    observation = clip_of(scene)
    problem, start, measured = prepared(FLIGHT, observation, 1)
    clip = ClipFit(problem.reference(FLIGHT.shapes), measured, observation.size, observation.length)
    hypothesis = Hypothesis(base_space(start.scene))
    base = clip.fit(hypothesis, np.zeros(hypothesis.dimension), 10)
    view = view_of(clip, base, observation, start.matching)
    return clip, base, Screen(clip, base, view).away(["camera_roll", "wind", "magnus", "drag"])


def test_only_what_is_imitated_is_tried_from_afar(rolled):
    _, base, leads = rolled
    assert {(lead.name, lead.target) for lead in leads} == {("camera_roll", -1), ("magnus", 0)}
    assert leads[0].gain >= leads[1].gain
    for lead in leads:
        width = lead.start.width
        assert width is not None
        assert lead.whole
        assert np.abs(lead.step / width).max() in np.abs(AWAY)
        assert lead.shift.shape == (base.hypothesis.dimension,)


def test_such_a_fit_begins_with_all_of_the_step_and_finds_the_effect(rolled):
    clip, base, leads = rolled
    lead = next(one for one in leads if one.name == "camera_roll")
    one = lead.term(clip.frames)
    hypothesis = base.hypothesis.added(one)
    z = beginning(clip, hypothesis, base, lead, lead.z(one))
    assert z[-1] == lead.z(one)[0] != 0.0
    some = dataclasses.replace(lead, step=1e-3 * lead.step, whole=False)
    assert abs(beginning(clip, hypothesis, base, some, some.z(one))[-1]) < abs(z[-1])
    fitted = {}
    _keep_leads(clip, base, fitted, [(base, lead, SCALE)], lambda line: None, FLIGHT)
    [(fit, promise)] = fitted.values()
    assert promise == lead.gain
    assert fit.evidence > base.evidence + 30
    assert fit.hypothesis.values(fit.z[None], 0)[0, 0] == pytest.approx(ANGLE, abs=1.5)


def test_what_is_imitated_can_be_much_or_nothing(rolled):
    clip = rolled[0]
    imitated = {name for name, kind in catalogue().items() if kind.imitated}
    assert {"camera_roll", "lens_distortion", "magnus"} <= imitated
    assert not imitated & {"push", "hidden_obstacle", "dropped_frames"}
    for name in imitated:
        for p in catalogue()[name].spread(clip.frames):
            assert p.low < p.centre < p.high, name
