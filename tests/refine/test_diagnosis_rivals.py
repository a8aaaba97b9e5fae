"""What is left undone where nothing leads, or one effect outdoes all others."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_diagnosis_candidates import candidate

from mjx_refine.diagnosis.fits.candidates import DOUBT, OUTDONE, Candidate, rivals
from mjx_refine.diagnosis.search import compare as search
from mjx_refine.diagnosis.search import exchange, pairs, singles

BEST = candidate(1000.0, ("camera_shake", -1))
NEAR = candidate(1.01 * OUTDONE * BEST.lead, ("drag", 0))
FAR = candidate(0.99 * OUTDONE * BEST.lead, ("push", 0))
LAST = candidate(0.5 * OUTDONE * BEST.lead, ("magnus", 0))


def test_what_leads_by_far_less_than_the_best_is_no_rival():
    assert rivals((BEST, NEAR, FAR, LAST)) == [BEST, NEAR]
    assert rivals(()) == []
    assert rivals((candidate(-3.0, ("drag", 0)),)) != []


@pytest.mark.parametrize(
    ("lead", "misfit", "hardly"),
    [
        (0.99 * singles.HARDLY, 1.0, True),
        (1.01 * singles.HARDLY, 1.0, False),
        (1.01 * singles.HARDLY, 1.2, True),
        (0.0, 1.01 * singles.LEFT, False),
        (-5.0, 0.1, True),
    ],
)
def test_little_is_gained_on_a_base_model_that_leaves_little(lead, misfit, hardly):
    """By leads in units of the misfit left, and only where that is little."""
    base: Any = SimpleNamespace(evidence=0.0)
    clip: Any = SimpleNamespace(misfit=lambda fit: misfit)
    one = candidate(lead, ("drag", 0)).fit
    assert singles._hardly(clip, base, {("drag", 0): (one, 0.0)}) is hardly


def test_without_any_effect_little_is_gained():
    base: Any = SimpleNamespace(evidence=0.0)
    clip: Any = SimpleNamespace(misfit=lambda fit: 1.0)
    assert singles._hardly(clip, base, {})


def test_a_patch_of_the_floor_counts_with_its_doubt():
    base: Any = SimpleNamespace(evidence=0.0)
    clip: Any = SimpleNamespace(misfit=lambda fit: 1.0)
    patch = candidate(singles.HARDLY + 0.9 * DOUBT["friction_patch"], ("friction_patch", -1)).fit
    assert singles._hardly(clip, base, {("friction_patch", -1): (patch, 0.0)})


def test_twos_of_effects_that_the_best_outdoes_are_not_put_together(monkeypatch):
    monkeypatch.setattr(pairs, "_one_cause", lambda one, other: False)
    monkeypatch.setattr(pairs, "_starts_of_two", lambda clip, base, one, other: [(one.names[0], other.names[0])])
    nothing: Any = None
    found = [two for two in pairs._together(nothing, nothing, (BEST, NEAR, FAR, LAST))]
    assert found == [("camera_shake", "drag"), ("camera_shake", "push"), ("camera_shake", "magnus")]
    equal = candidate(900.0, ("wind", -1))
    found = [two for two in pairs._together(nothing, nothing, (BEST, equal, NEAR))]
    assert found == [("camera_shake", "wind"), ("camera_shake", "drag"), ("wind", "drag")]


def test_nothing_is_looked_for_beside_what_the_best_outdoes(monkeypatch):
    monkeypatch.setattr(pairs, "_one_cause", lambda one, other: False)
    assert pairs._firsts((BEST, FAR)) == [BEST]
    assert pairs._firsts((BEST, NEAR, FAR)) == [BEST, NEAR]


def test_with_new_noise_what_the_best_outdoes_is_given_up_where_it_stays_behind(monkeypatch):
    """And stands at no size where that is behind the base model."""
    asked: list[tuple[str, float]] = []

    def each(clip, piece, rows):
        asked.extend((row[0].hypothesis.terms[0].name if row[0].hypothesis.terms else "", row[2]) for row in rows)
        return [row[0] for row in rows]

    clip: Any = SimpleNamespace(
        crew=SimpleNamespace(each=each),
        measured=SimpleNamespace(moment_noise=1.0),
        settle_noise=lambda fit, order: None,
        allow_chaos=lambda fit, seed: None,
        allow_slack=lambda fit: 0,
    )
    behind: list[Any] = []

    def nothing(clip, base, fitted):
        behind.extend(fit for fit, _ in fitted.values())
        return fitted

    monkeypatch.setattr(search, "_along_its_own", lambda clip, fit: fit)
    monkeypatch.setattr(exchange, "at_least_nothing", nothing)
    monkeypatch.setattr(exchange, "surely", lambda clip, base, fitted: (base, fitted))
    for module in (exchange, search):
        monkeypatch.setattr(module, "in_order", lambda clip, found: tuple(found))
    base: Any = SimpleNamespace(hypothesis=SimpleNamespace(terms=()), evidence=0.0)
    BEST.fit.cost = 7.0
    two = candidate(1001.0, ("camera_shake", -1), ("drag", 0))
    _, found, twos, _ = search._again(clip, base, (BEST, NEAR, FAR), (two,), 0)
    own = [("", np.inf), ("camera_shake", np.inf), ("drag", np.inf), ("push", 7.0), ("camera_shake", np.inf)]
    assert asked == own
    assert [one.names for one in found] == [("camera_shake",), ("drag",), ("push",)]
    assert behind == [BEST.fit, NEAR.fit, FAR.fit, two.fit]
    assert all(isinstance(one, Candidate) for one in twos)


@pytest.mark.parametrize(
    ("misfit", "smooth", "unsteady", "noise"),
    [(0.9, 0.6, 0.1, True), (1.1, 0.6, 0.1, False), (0.9, 0.8, 0.1, False), (0.9, 0.6, 0.7, False)],
)
def test_beside_what_leaves_only_noise_no_second_effect_is_looked_for(monkeypatch, misfit, smooth, unsteady, noise):
    """Unless two that were found before lead it."""
    monkeypatch.setattr(pairs, "structure", lambda clip, fit: smooth)
    monkeypatch.setattr(pairs, "unsteadiness", lambda clip, fit: unsteady)
    monkeypatch.setattr(pairs, "in_order", lambda clip, found: tuple(found))
    looked: list[Any] = []
    monkeypatch.setattr(pairs, "_beside", lambda clip, firsts, *rest: looked.extend(firsts) or [])
    clip: Any = SimpleNamespace(misfit=lambda fit: misfit)
    nothing: Any = None
    behind, ahead = (candidate(lead, ("camera_shake", -1), ("drag", 0)) for lead in (BEST.lead - 1, BEST.lead + 1))
    assert pairs.pairs_of(clip, nothing, (BEST,), (behind,), [], nothing, 0, nothing) == (behind,)
    assert looked == ([] if noise else [BEST])
    looked.clear()
    with pytest.raises(AttributeError):  # it goes on to fit them
        pairs.pairs_of(clip, nothing, (BEST,), (ahead,), [], nothing, 0, nothing)
    assert looked == [BEST]


@pytest.mark.parametrize(("without", "kept"), [(-60.0, "plain"), (-200.0, "nodes")])
def test_what_leads_is_held_against_the_base_model_without_states_after_impacts_too(monkeypatch, without, kept):
    monkeypatch.setattr(exchange, "in_order", lambda clip, found: tuple(found))
    monkeypatch.setattr(exchange, "at_least_nothing", lambda clip, base, fitted: fitted)
    monkeypatch.setattr(exchange, "surely", lambda clip, base, fitted: (base, fitted))
    monkeypatch.setattr(search, "_refitted", lambda clip, fit, iterations, rival: fit)
    nodes, plain = (SimpleNamespace(evidence=evidence) for evidence in (-150.0, without))
    one = candidate(search.CLEAR + 10.0, ("drag", 0))
    clip: Any = None
    base, singles, pairs = search._against_both(clip, nodes, plain, (one,), ())  # type: ignore[arg-type]
    assert base is (plain if kept == "plain" else nodes)
    assert singles[0].lead == pytest.approx(one.fit.evidence + 60.0 if kept == "plain" else one.lead)
    assert pairs == ()
    little = candidate(0.9 * search.CLEAR, ("drag", 0))
    assert search._against_both(clip, nodes, plain, (little,), ())[0] is nodes  # type: ignore[arg-type]


def test_an_effect_that_needs_no_states_after_impacts_is_told_without(monkeypatch):
    """Twelve more numbers for every state take in what acts all along, and cost evidence."""
    monkeypatch.setattr(search, "in_order", lambda clip, found: tuple(sorted(found, key=lambda one: -one.lead)))
    monkeypatch.setattr(search, "_refitted", lambda clip, fit, iterations, rival: fit)
    clip: Any = SimpleNamespace(
        crew=SimpleNamespace(each=lambda clip, piece, rows: [piece(clip, *row) for row in rows])
    )
    base: Any = SimpleNamespace(evidence=5.0)
    slope, drag = candidate(20.0, ("slope", -1)), candidate(30.0, ("drag", 0))
    found = [candidate(lead, one) for lead, one in ((70.0, ("slope", -1)), (25.0, ("drag", 0)), (60.0, ("wind", -1)))]
    weak = dataclasses.replace(found[2], lead=search.CLEAR - 1)
    told = search._or_without(clip, base, (drag, slope), (found[0], weak))
    assert [(one.names[0], one.lead) for one in told] == [("slope", 65.0), ("drag", 30.0)]
    assert told[0].fit is found[0].fit
    assert search._or_without(clip, base, (drag, slope), ()) == (drag, slope)
    # One that explains less without them keeps them.
    told = search._or_without(clip, base, (drag,), (dataclasses.replace(found[1], lead=90.0),))
    assert told[0].fit is drag.fit
