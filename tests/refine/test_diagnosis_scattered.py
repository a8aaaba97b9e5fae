"""Least squares from many places."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagnosis_staged import STRUCK, clip_of, started

from mjx_refine.diagnosis.fits.base import base_space
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.search.scattered import scattered
from mjx_refine.diagnosis.search.tempered import WARM, tempered


@pytest.fixture(scope="module")
def stuck():
    """Residuals of a clip in which a box strikes a ball, and the base model's fit, which has ended in a poor hollow."""
    box, ball = STRUCK.objects
    late = dataclasses.replace(box, linear_velocity=(2.0, 0.05, 0.0))
    _, start, clip = started(dataclasses.replace(STRUCK, objects=(late, ball)), clip_of(STRUCK, 24))
    hypothesis = Hypothesis(base_space(start.scene))
    with tempered(clip, WARM):
        fit = clip.fit(hypothesis, np.zeros(hypothesis.dimension), 10)
    return clip, clip.fit(hypothesis, fit.z, 2)


def test_a_better_hollow_is_found_and_the_same_one_every_time(stuck):
    clip, fit = stuck
    count = len(fit.z)
    (better,) = scattered(clip, [fit], [], count, 0)
    (again,) = scattered(clip, [fit], [], count, 0)
    assert better.evidence > fit.evidence + 20
    assert not better.hypothesis.terms
    assert np.array_equal(better.z, again.z)


def test_what_others_found_for_the_ordinary_numbers_is_tried(stuck, monkeypatch):
    clip, fit = stuck
    count = len(fit.z)
    (best,) = scattered(clip, [fit], [], count, 0)
    biased = fit.hypothesis.added(term("mask_bias", -1, clip.frames))
    wide = clip.fit(biased, np.concatenate([fit.z, np.zeros(len(biased.bounds[0]) - count)]), 2)
    monkeypatch.setattr("mjx_refine.diagnosis.search.scattered._draws", lambda *_: [])
    (without,) = scattered(clip, [wide], [], count, 0)
    (with_it,) = scattered(clip, [wide], [best], count, 0)
    assert without is wide
    assert with_it.evidence > wide.evidence + 20


def test_nothing_becomes_worse(stuck):
    clip, fit = stuck
    (best,) = scattered(clip, [fit], [], len(fit.z), 0)
    ends = scattered(clip, [best, fit], [best, fit], len(fit.z), 1)
    assert ends[0].evidence >= best.evidence
    assert ends[1].evidence >= fit.evidence
