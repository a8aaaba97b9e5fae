"""Frames that are missing at an impact, which the state after it would take in."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagnosis import clip_of
from test_diagnosis_replay import started
from test_shooting import BALL

from mjx_refine.diagnosis.fits.base import base_space
from mjx_refine.diagnosis.fits.fit import SCALE
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.fits.shown import view_of
from mjx_refine.diagnosis.search import singles
from mjx_refine.diagnosis.search.lost import NAME, PROMISED, lost_frames, recounted
from mjx_refine.diagnosis.search.shooting import base_with_nodes, with_nodes
from mjx_refine.scene import Effect

DROPPED = Effect(NAME, None, (("frame", 10), ("count", 3)))


def seen(*effects: Effect):
    """Residuals of a ball that bounces, its base model's fit, and what is shown."""
    observation = clip_of(dataclasses.replace(BALL, effects=effects), 30)
    _, start, clip = started(BALL, observation)
    hypothesis = Hypothesis(base_space(start.scene))
    base = clip.fit(hypothesis, np.zeros(hypothesis.dimension), 10)
    clip.settle_noise(base)
    clip.allow_slack(base)
    base = clip.fit(base.hypothesis, base.z, 10)
    return clip, base, view_of(clip, base, observation, start.matching)


@pytest.fixture(scope="module")
def dropped():
    return seen(DROPPED)


def test_missing_frames_are_found_to_the_frame_beside_the_base_model(dropped):
    clip, base, view = dropped
    (found,) = lost_frames(clip, base, view)
    assert found.names == (NAME,)
    assert found.lead > PROMISED
    assert found.fit.hypothesis.terms[0].centre.tolist() == [10.0, 3.0]


@pytest.fixture(scope="module")
def miscounted(dropped):
    """The fit with two frames too few, to which ordinary numbers have bent."""
    clip, base, _ = dropped
    return clip.fit(base.hypothesis.added(term(NAME, -1, clip.frames, np.array([10.0, 1.0]))), base.z, 10)


def test_a_wrong_count_is_left_for_the_one_beside_it(dropped, miscounted):
    clip, _, _ = dropped
    better = recounted(clip, miscounted)
    assert better.hypothesis.terms[0].centre.tolist() == [10.0, 3.0]
    assert better.evidence > miscounted.evidence + PROMISED


@pytest.mark.parametrize("rival", [0.0, np.inf])
def test_frames_are_counted_anew_once_where_they_lead_by_much(dropped, miscounted, monkeypatch, rival):
    clip, _, _ = dropped
    asked = []
    monkeypatch.setattr(singles, "recounted", lambda clip, fit: asked.append(fit) or fit)
    base = dataclasses.replace(miscounted, evidence=miscounted.evidence - 1.01 * singles.CLEAR)
    fitted = {
        (NAME, -1): (miscounted, 1.0),
        ("push", 0): (dataclasses.replace(base, evidence=base.evidence + rival), 1.0),
    }
    before: list = []
    for _ in range(2):
        singles._recounted(clip, base, fitted, before)
    assert len(asked) == (1 if rival == 0.0 else 0)


def test_nothing_is_missing_where_nothing_is():
    clip, base, view = seen()
    assert lost_frames(clip, base, view) == ()


def test_of_several_paths_those_impacts_are_kept_that_explain_most(dropped):
    clip, base, view = dropped
    (found,) = lost_frames(clip, base, view)
    kept, evidence = clip.settled, []
    mine, other = with_nodes(clip, base), with_nodes(clip, found.fit)
    for theres in ([mine], [other], [mine, other]):
        clip.settled = kept
        fit = base_with_nodes(clip, base, theres, 0)
        # In the noise before it was taken from the fit's own residuals.
        clip.settled = kept
        evidence.append(clip.at(fit.hypothesis, fit.z, scale=SCALE).evidence)
    clip.settled = kept
    assert evidence[2] == pytest.approx(max(evidence[:2]), abs=5.0)
