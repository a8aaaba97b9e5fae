"""Where simulation and clip part."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagnosis import FLIGHT, clip_of
from test_diagnosis_replay import started

from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.fits.shown import view_of
from mjx_refine.diagnosis.misfit.where import background_energy, places_of
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


@pytest.mark.parametrize(
    ("kind", "loud"), [("shift", True), ("roll", True), ("zoom", True), ("beside an object", False)]
)
def test_the_background_moves_where_it_moves_as_one(kind, loud):
    observation = clip_of(FLIGHT)
    _, start, clip = started(FLIGHT, observation)
    base = Hypothesis(Space.around(start.scene))
    places = clip.measured.places
    x, y = (places - places.mean(0)).T / 100.0
    moved = {
        "shift": np.stack([0 * x + 0.5, 0 * y - 0.3], -1),
        "roll": np.stack([-y, x], -1) * 0.5,
        "zoom": np.stack([x, y], -1) * 0.5,
        "beside an object": np.where(np.arange(len(x))[:, None] % 17 == 3, [1.0, -2.0], 0.0),
    }[kind]
    clip.measured = dataclasses.replace(clip.measured, background=clip.measured.background + moved)
    energy = background_energy(clip, clip.at(base, np.zeros(base.dimension)))
    assert len(energy) == clip.frames
    assert energy[-1] == 0.0
    assert (energy[:-1] > 1.0).all() if loud else (energy[:-1] < 0.6).all()
