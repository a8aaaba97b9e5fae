"""Impacts with unseen things may err: by what, at what price, and what that makes of an obstacle that rubs and twists."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagnosis import FLIGHT, clip_of
from test_diagnosis_replay import started

from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.fits.knock import excuses, knocked, strike_notes
from mjx_refine.diagnosis.fits.slack import slack_of
from mjx_refine.scene import Effect
from mjx_refine.space import Space

FRAMES = 20
WALL = Effect("hidden_obstacle", "ball", (("angle", 180.0), ("distance", 0.1), ("restitution", 0.5)))
HIT = 7
"""The frame in which the ball, 0.6 m off at 2.6 m/s, hits the wall."""


def fitted(effects: tuple[Effect, ...]):
    """(residuals of a clip with these effects, an obstacle's hypothesis, its z at the wall's own numbers)."""
    clip = clip_of(dataclasses.replace(FLIGHT, effects=effects))
    _, start, fit_of = started(FLIGHT, clip)
    values = np.array([value for _, value in WALL.parameters])
    hypothesis = Hypothesis(Space.around(start.scene), (term("hidden_obstacle", 0, FRAMES, values),))
    return fit_of, hypothesis, np.zeros(hypothesis.dimension)


def test_the_price_is_half_the_logarithm_of_the_determinant():
    columns = np.random.default_rng(1).normal(size=(9, 2)) * [4.0, 1.0]
    wanted = 0.5 * np.linalg.slogdet(np.eye(9) + columns @ columns.T)[1]
    assert slack_of(columns).price == pytest.approx(wanted)


def test_only_what_follows_the_impact_is_excused():
    fit_of, hypothesis, z = fitted((WALL,))
    fit_of.allow_slack(fit_of.at(hypothesis, z))
    columns = excuses(fit_of, hypothesis, z, 0)
    assert columns is not None
    assert strike_notes(hypothesis, ["ball"]) == []
    errs = dataclasses.replace(hypothesis, terms=(dataclasses.replace(hypothesis.terms[0], excused=columns),))
    (note,) = strike_notes(errs, ["ball"])
    assert note.startswith("What ball gets from the hidden_obstacle may err by 25% of its change of velocity")
    reach = np.array([np.abs(fit_of.measured.split(c).reach).max((1, 2)) for c in columns.T]).max(0)
    assert not reach[: HIT - 1].any()
    assert reach[HIT + 4 :].min() > 0


def test_a_wall_that_is_never_met_excuses_nothing():
    fit_of, hypothesis, z = fitted(())
    far = dataclasses.replace(hypothesis.terms[0], centre=np.array([180.0, -9.0, 0.5]))
    fit = fit_of.at(dataclasses.replace(hypothesis, terms=(far,)), z)
    assert excuses(fit_of, fit.hypothesis, fit.z, 0) is None
    assert knocked(fit_of, fit) is fit


def test_other_hypotheses_are_left_alone():
    fit_of, hypothesis, _ = fitted((WALL,))
    drag = dataclasses.replace(hypothesis, terms=(term("drag", 0, FRAMES),))
    fit = fit_of.at(drag, np.zeros(drag.dimension))
    assert knocked(fit_of, fit) is fit


def test_a_blow_aside_at_the_wall_is_excused_at_its_price():
    # What hits the ball turns it aside as well, by a quarter of its change of velocity, as no plane does.
    mass = 1.0 if FLIGHT.objects[0].mass is None else FLIGHT.objects[0].mass
    aside = Effect("push", "ball", (("time", 0.235), ("x", 0.0), ("y", 0.9 * mass), ("z", 0.0)))
    fit_of, hypothesis, z = fitted((WALL, aside))
    stiff = fit_of.fit(hypothesis, z, 8)
    fit_of.allow_slack(fit_of.fit(Hypothesis(hypothesis.space), np.zeros(hypothesis.space.dimension), 8))
    stiff = fit_of.fit(hypothesis, stiff.z, 8)
    soft = knocked(fit_of, stiff)
    assert soft.hypothesis.excused is not None
    assert soft.evidence > stiff.evidence + 20.0
    assert fit_of.misfit(soft) < fit_of.misfit(stiff)
    # Held-out frames and a second effect are fitted with it; without the clip's own slack nothing is excused.
    keep = np.arange(FRAMES) % 4 != 3
    assert np.isfinite(fit_of.fit(soft.hypothesis, soft.z, 2, keep=keep).evidence)
    fit_of.forget_slack(fit_of.noise)
    again = fit_of.at(soft.hypothesis, soft.z)
    bare = dataclasses.replace(soft.hypothesis, terms=(dataclasses.replace(soft.hypothesis.terms[0], excused=None),))
    assert again.data == pytest.approx(fit_of.at(bare, soft.z).data)
