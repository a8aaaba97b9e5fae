"""Where simulation and clip part."""

from __future__ import annotations

import numpy as np
import pytest
from test_diagnosis import FLIGHT, clip_of
from test_diagnosis_replay import started

from mjx_refine.diagnosis.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.shown import view_of
from mjx_refine.diagnosis.where import places_of
from mjx_refine.space import Space


@pytest.mark.parametrize(("effect", "places"), [("drag", 1), ("push", 2)])
def test_what_acts_where_it_is_loud_is_one_place(effect, places):
    observation = clip_of(FLIGHT)
    _, start, clip = started(FLIGHT, observation)
    base = Hypothesis(Space.around(start.scene))
    acted = base.added(term(effect, 0, clip.frames))
    plain, best = (clip.at(h, np.zeros(h.dimension)) for h in (base, acted))
    energy = np.ones((1, clip.frames))
    energy[0, 4:9] = 5.0
    before = (energy, np.zeros((1, clip.frames), int), np.zeros(clip.frames))
    after = np.where(energy > 1, 2.0, 1.0)
    found = places_of(before, after, plain, best, view_of(clip, best, observation, start.matching))
    assert len(found) == places
    assert sum(place.share for place in found) == pytest.approx(1.0)
