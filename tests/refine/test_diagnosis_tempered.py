"""Fits that begin where noise is thought to be larger."""

from __future__ import annotations

import contextlib
import dataclasses

import numpy as np
import pytest
from test_diagnosis import FLIGHT, clip_of
from test_diagnosis_replay import started

from mjx_refine.diagnosis.diagnose import _unmatched
from mjx_refine.diagnosis.fits.base import base_space
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.shown import view_of
from mjx_refine.diagnosis.search.leads import chosen_of
from mjx_refine.diagnosis.search.screen import Screen
from mjx_refine.diagnosis.search.tempered import annealed, beside_tempered, cooled, tempered
from mjx_refine.scene import Effect

WIND, ROLL = (
    Effect("wind", None, (("x", -9.0), ("y", 6.0))),
    Effect("camera_roll", None, (("angle", 7.0),)),
)


def started_with(*effects: Effect):
    """Residuals of a flight with effects, its base model's fit from the given scene, and what is shown."""
    observation = clip_of(dataclasses.replace(FLIGHT, effects=effects), 30)
    _, start, clip = started(FLIGHT, observation)
    hypothesis = Hypothesis(base_space(start.scene))
    base = clip.fit(hypothesis, np.zeros(hypothesis.dimension), 10)
    clip.settle_noise(base)
    clip.allow_slack(base)
    return clip, base, lambda fit: view_of(clip, fit, observation, start.matching)


@pytest.fixture(scope="module")
def blown():
    """A flight in the wind that a rolled camera filmed."""
    return started_with(WIND, ROLL)


def quiet(line: str) -> None:
    """Whoever is told a line."""


def test_there_is_more_noise_for_a_while_and_nothing_else_may_err(blown):
    clip, base, _ = blown
    plain = dataclasses.replace(base.hypothesis, slack=None)

    def moments():
        distances = clip.distances(clip.predictor(clip.poses(plain, base.z[None]), plain.batch(base.z[None])))
        return clip.measured.split(clip.rigid(distances, None, 1e9)[0]).moments

    before, state, columns = moments(), clip.state(), clip.slack_columns
    with contextlib.suppress(ZeroDivisionError), tempered(clip, 10.0):
        assert np.allclose(10 * moments(), before)
        assert clip.slack_columns.shape[1] == 0
        assert clip.state() != state
        raise ZeroDivisionError
    assert clip.state() == state
    assert np.array_equal(clip.slack_columns, columns)
    assert np.array_equal(moments(), before)


IMITATED = ["wind", "drag", "camera_roll", "mask_bias", "push"]


def test_effects_are_found_that_the_base_model_has_bent_to(blown):
    clip, base, shown = blown
    better, ended, unbent = annealed(clip, base, IMITATED, shown, 0, quiet, lambda lead: lead.name)
    found = {lead.name: fit for lead, fit in ended}
    assert {"wind", "camera_roll"} <= set(found)
    assert max(found, key=lambda name: found[name].evidence) in ("wind", "camera_roll")
    assert found["camera_roll"].evidence > base.evidence + 30
    assert [fit.cost for fit in unbent] == sorted(fit.cost for fit in unbent)
    assert len(unbent) == len(ended)
    # The base model goes the same way, and ends no worse than it was.
    assert better.evidence >= base.evidence
    assert not better.hypothesis.terms


@pytest.mark.parametrize("names", [["mask_bias"], pytest.param(IMITATED, marks=pytest.mark.slow)])
def test_the_same_is_found_again(blown, names):
    clip, base, shown = blown
    first, again = (annealed(clip, base, names, shown, 0, quiet, lambda lead: lead.name)[1] for _ in range(2))
    assert [fit.evidence for _, fit in again] == [fit.evidence for _, fit in first]


def test_a_second_effect_is_found_beside_the_first(blown):
    clip, base, shown = blown
    _, ended, unbent = annealed(clip, base, ["camera_roll", "mask_bias"], shown, 0, quiet, lambda lead: lead.name)
    roll = next(fit for lead, fit in ended if lead.name == "camera_roll")
    straight = [fit for fit in unbent if fit.hypothesis.terms[0].name == "camera_roll"]
    lines: list[str] = []
    twos = beside_tempered(clip, [roll], straight, lambda fit: ["wind", "magnus", "mask_bias"], shown, lines.append, 3)
    assert "camera_roll and wind" in lines
    assert [fit.cost for _, fit in twos] == sorted(fit.cost for _, fit in twos)
    lead, fit = twos[0]
    assert lead.name == "wind"
    # Roll, pressure and slowness of the wind trade with one another: least squares go along that valley slowly.
    both = clip.fit(cooled(clip, fit), fit.z, 40)
    assert both.evidence > roll.evidence + 30
    assert both.hypothesis.values(both.z[None], 0)[0, 0] == pytest.approx(7.0, abs=1.5)


@pytest.mark.parametrize(
    ("matching", "words"),
    [((1, 2, 4), None), ((4, -1, 1), "belongs to mask 2:"), ((-1,), "belongs to masks 1, 2, 4:")],
)
def test_masks_without_an_object_are_told_of(matching, words):
    told = _unmatched((1, 2, 4), matching)
    assert told == [] if words is None else words in told[0]


def test_what_the_most_noise_hides_is_looked_for_with_less():
    """Nothing promises anything in this wind where noise is ten times what it is; with three times something does."""
    clip, base, shown = started_with(Effect("wind", None, (("x", -3.0), ("y", 2.0))))
    names = ["wind", "drag", "camera_roll", "mask_bias", "push"]
    with tempered(clip, 10.0):
        ground = clip.fit(dataclasses.replace(base.hypothesis, slack=None), 0 * base.z, 10)
        promised = chosen_of(Screen(clip, ground, shown(ground)).leads(names), 10, 1)
    assert not promised
    _, ended, _ = annealed(clip, base, names, shown, 0, quiet, lambda lead: lead.name)
    assert max(fit.evidence for _, fit in ended) > base.evidence + 100
