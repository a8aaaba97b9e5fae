"""Contacts may err along a hypothesis' own path: at its own price, and handed on together with the ordinary numbers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_diagnosis import clip_of
from test_diagnosis_replay import BOUNCE, started

from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.knock import knocked
from mjx_refine.diagnosis.search.exchange import begun_again
from mjx_refine.space import Space


@pytest.fixture(scope="module")
def bounced():
    """(residuals of a bounce whose contacts may err along the given path, the hypothesis, a point far from there)."""
    clip = clip_of(BOUNCE)
    _, start, fit_of = started(BOUNCE, clip)
    space = Space.around(start.scene)
    fit_of.allow_slack(fit_of.at(Hypothesis(space), np.zeros(space.dimension)))
    faster = np.array([0.6 if p.field == "linear_velocity" and p.index[1] == 2 else 0.0 for p in space.parameters])
    return fit_of, Hypothesis(space), faster


def own(fit_of, fit):
    return dataclasses.replace(fit.hypothesis, slack=fit_of.slack_along(fit))


def test_along_the_given_path_a_hypothesis_own_slack_is_the_clips(bounced):
    fit_of, hypothesis, z = bounced
    there = fit_of.at(hypothesis, 0 * z)
    assert fit_of.at(own(fit_of, there), 0 * z).evidence == pytest.approx(there.evidence, rel=1e-6)


def test_along_another_path_it_is_another_at_its_own_price(bounced):
    fit_of, hypothesis, z = bounced
    there = fit_of.at(hypothesis, z)
    loose = own(fit_of, there)
    assert loose.slack is not None
    assert loose.slack.shape != fit_of.slack_columns.shape or not np.allclose(loose.slack, fit_of.slack_columns)
    again = fit_of.at(loose, z)
    price = 0.5 * np.linalg.slogdet(np.eye(loose.slack.shape[1]) + loose.slack.T @ loose.slack)[1]
    told = -again.cost - 0.5 * np.linalg.slogdet(again.curvature)[1] - price
    # Errors that nobody would see are left out of the price.
    assert again.evidence == pytest.approx(told, abs=0.02 * loose.slack.shape[1])


def test_a_fit_whose_contacts_are_elsewhere_explains_no_less_with_its_own(bounced):
    fit_of, hypothesis, z = bounced
    fit = fit_of.fit(hypothesis, z, 4)
    soft = knocked(fit_of, fit)
    assert soft.evidence >= fit.evidence


def test_what_may_err_goes_with_the_ordinary_numbers_that_are_handed_on(bounced):
    fit_of, hypothesis, z = bounced
    best = fit_of.at(own(fit_of, fit_of.at(hypothesis, 0 * z)), 0 * z)
    far = fit_of.at(own(fit_of, fit_of.at(hypothesis, 3 * z)), 3 * z)
    again = begun_again(fit_of, far, [best], len(z))
    assert again.evidence > far.evidence
    assert again.hypothesis.slack is not None
    assert not np.array_equal(again.hypothesis.slack, far.hypothesis.slack)


def test_where_contacts_may_not_err_a_hypothesis_own_do_not_either():
    clip = clip_of(BOUNCE)
    _, start, fit_of = started(BOUNCE, clip)
    plain = Hypothesis(Space.around(start.scene))
    z = np.full(plain.dimension, 0.2)
    fit_of.allow_slack(fit_of.at(plain, z))
    loose = own(fit_of, fit_of.at(plain, z))
    fit_of.forget_slack(fit_of.noise)
    assert fit_of.slack_along(fit_of.at(plain, z)) is None
    assert fit_of.at(loose, z).data == pytest.approx(fit_of.at(plain, z).data)
