"""Which of the fitted effects stands first: leads, and what is taken off them."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from test_diagnosis import FLIGHT

from mjx_refine.diagnosis.fits import candidates
from mjx_refine.diagnosis.fits.base import base_space
from mjx_refine.diagnosis.fits.candidates import (
    AGAINST,
    AT_IMPACT,
    DOUBT,
    LEAST_UNIT,
    Candidate,
    Compared,
    in_order,
    lead_of,
)
from mjx_refine.diagnosis.fits.fitted import Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, term
from mjx_refine.diagnosis.search import compare as search
from mjx_refine.diagnosis.search import pairs, singles
from mjx_refine.diagnosis.search.walls import push_last
from mjx_refine.effects.push import Push
from mjx_refine.sim.c import MujocoSimulator

MISFIT = 0.8
PRICE = AGAINST * MISFIT


@pytest.fixture(autouse=True)
def _short_hits(request, monkeypatch):
    """Obstacles are hit and left, but where a test is about that."""
    if "leant" not in request.node.name:
        monkeypatch.setattr(candidates, "leans_on", lambda clip, fit: False)
    if "impact" not in request.node.name:
        monkeypatch.setattr(candidates, "_bounces", lambda clip, fit: False)


def candidate(lead: float, *terms: tuple[str, int]) -> Candidate:
    told = tuple(SimpleNamespace(name=name, target=target) for name, target in terms)
    fit: Any = SimpleNamespace(hypothesis=SimpleNamespace(terms=told), evidence=lead)
    return Candidate(fit, lead, 0.0)


def order(*found: Candidate, misfit: float = MISFIT) -> list[tuple[str, float]]:
    clip: Any = SimpleNamespace(misfit=lambda fit: misfit)
    return [("+".join(one.names), one.lead) for one in in_order(clip, found)]


def test_an_obstacle_that_explains_a_push_nearly_as_well_stands_before_it():
    wall, push = candidate(50.0, ("hidden_obstacle", 0)), candidate(50.0 + 0.9 * PRICE, ("push", 0))
    drag = candidate(49.0, ("drag", 0))
    told = order(push, drag, wall)
    assert [name for name, _ in told] == ["hidden_obstacle", "drag", "push"]
    assert told[2][1] == pytest.approx(push.lead - PRICE)
    # However little is left, noise widths have a floor.
    assert order(push, wall, misfit=0.0)[0][0] == "push"
    assert (
        order(push, dataclasses.replace(wall, lead=push.lead - 0.9 * AGAINST * LEAST_UNIT), misfit=0.0)[1][0] == "push"
    )


@pytest.mark.parametrize(
    ("push", "wall"),
    [
        (candidate(50.0 + 1.1 * PRICE, ("push", 0)), candidate(50.0, ("hidden_obstacle", 0))),
        (candidate(51.0, ("push", 1)), candidate(50.0, ("hidden_obstacle", 0))),
        (candidate(51.0, ("push", 0), ("drag", 0)), candidate(50.0, ("hidden_obstacle", 0))),
        (candidate(51.0, ("push", 0), ("drag", 0)), candidate(50.0, ("hidden_obstacle", 0), ("drag", 1))),
        (candidate(51.0, ("drag", 0)), candidate(50.0, ("hidden_obstacle", 0))),
    ],
)
def test_any_other_lead_stands(push, wall):
    assert order(wall, push) == [("+".join(push.names), push.lead), ("+".join(wall.names), wall.lead)]


def test_beside_another_effect_an_obstacle_stands_before_a_push_too():
    both = candidate(90.0, ("push", 1), ("camera_motion", -1))
    wall = candidate(85.0, ("camera_motion", -1), ("hidden_obstacle", 1))
    assert [name for name, _ in order(both, wall)] == ["camera_motion+hidden_obstacle", "push+camera_motion"]


def left_early(share: float) -> np.ndarray:
    """Distances from a wall that is touched from the beginning on, for a share of the time."""
    return np.where(np.arange(30) < share * 30, 0.002, 0.05)


def stayed_at(speed: float) -> np.ndarray:
    """Distances from a wall that is reached in the sixth frame at a speed [m/s], and not left."""
    return np.maximum(speed * (6 - np.arange(30)) / 30.0, 0.0)


@pytest.mark.parametrize(
    ("away", "kept"),
    [(left_early(0.3), True), (left_early(0.7), False), (stayed_at(0.5), True), (stayed_at(0.1), False)],
)
def test_an_obstacle_that_is_leant_on_and_was_not_hit_is_none(away, kept):
    """A ball that rolls along the x axis past a wall at its side."""
    frames, radius = 30, FLIGHT.objects[0].size[0]
    hypothesis = Hypothesis(base_space(FLIGHT), (term("hidden_obstacle", 0, frames, np.array([90.0, 0.0, 0.5])),))
    z = np.zeros(hypothesis.dimension)
    poses = np.zeros((frames, 1, 7))
    poses[..., 3] = 1.0
    poses[:, 0, 0] = np.linspace(0.0, 2.0, frames)
    # The wall is y = 0, its outside y > 0.
    poses[:, 0, 1] = radius + away
    fit = Fit(hypothesis, z, 1.0, 1.0, np.zeros((1, len(z))), np.zeros(1), 0.0)
    clip: Any = SimpleNamespace(
        misfit=lambda fit: MISFIT, poses=lambda hypothesis, z: poses[None], simulator=SimpleNamespace(fps=30.0)
    )
    one = Candidate(fit, 50.0, 0.0)
    assert in_order(clip, [one]) == ((one,) if kept else ())


@pytest.mark.parametrize(("late", "less"), [(0.0, AT_IMPACT), (0.2, 0.0)])
def test_a_push_at_an_impact_leads_by_less(late, less):
    simulator = MujocoSimulator(FLIGHT.shapes, 30.0, 1)
    space = base_space(FLIGHT)
    plain = space.decode(space.start[None])
    height = simulator.rollout(plain, 30)[0, :, 0, 2]
    time = float(height.argmin()) / 30.0 + late
    hypothesis = Hypothesis(space, (term("push", 0, 30, np.array([time, 0.3, 0.0, 0.0])),))
    z = np.zeros(hypothesis.dimension)
    fit = Fit(hypothesis, z, 1.0, 1.0, np.zeros((1, len(z))), np.zeros(1), 0.0)
    clip: Any = SimpleNamespace(misfit=lambda fit: MISFIT, simulator=simulator, rollout=simulator.rollout, frames=30)
    told = in_order(clip, [Candidate(fit, 500.0, 0.0)])
    assert told[0].lead == pytest.approx(500.0 - less * MISFIT)


def test_a_patch_leads_by_less_than_its_evidence():
    base: Any = SimpleNamespace(evidence=-5.0)
    assert lead_of(candidate(40.0, ("friction_patch", -1)).fit, base) == 45.0 - DOUBT["friction_patch"]
    assert lead_of(candidate(40.0, ("drag", 0)).fit, base) == 45.0


def test_a_push_becomes_the_last_effect_and_takes_its_numbers_along():
    space = base_space(FLIGHT)
    terms = (term("push", 0, 30, np.array([0.3, 0.0, 0.0, 0.0])), term("drag", 0, 30))
    hypothesis = Hypothesis(space, terms)
    z = np.arange(hypothesis.dimension, dtype=float) / hypothesis.dimension
    fit = Fit(hypothesis, z, 1.0, 1.0, np.zeros((1, len(z))), np.zeros(1), 0.0)
    turned = push_last(fit)
    assert [t.name for t in turned.hypothesis.terms] == ["drag", "push"]
    for k, other in ((0, 1), (1, 0)):
        np.testing.assert_array_equal(hypothesis.values(z[None], k), turned.hypothesis.values(turned.z[None], other))
    np.testing.assert_array_equal(turned.z[: space.dimension], z[: space.dimension])
    again = push_last(turned)
    np.testing.assert_array_equal(again.z, turned.z)


@pytest.mark.parametrize(("time", "frames"), [(0.72, (21, 23)), (0.71, (20, 22)), (0.0, (0, 1)), (0.97, (28, 29))])
def test_a_push_shows_in_the_frame_that_is_nearest_and_in_its_neighbours(time, frames):
    view = SimpleNamespace(fps=30.0, frames=30)
    assert Push().window(view, 0, np.array([time, 1.0, 0.0, 0.0])) == frames


@pytest.mark.parametrize("without", ["", "hidden_obstacle", "friction_patch"])
def test_twos_with_a_push_are_tried_with_an_obstacle_and_with_a_patch_in_its_place(monkeypatch, without):
    def fitted(evidence: float) -> SimpleNamespace:
        return SimpleNamespace(evidence=evidence, cost=-evidence, hypothesis=SimpleNamespace(terms=()))

    def two(other: str, lead: float) -> Candidate:
        return candidate(lead, (other, -1), ("push", 0))

    asked: dict[str, list[float]] = {}

    def tried(name: str, clip, pushes, *rest) -> list[SimpleNamespace | None]:
        asked[name] = [row[0].evidence for row in pushes]
        return [None if row[0].evidence > 250.0 else fitted(row[0].evidence + 1.0) for row in pushes]

    monkeypatch.setattr(pairs, "push_last", lambda fit: fit)
    monkeypatch.setattr(pairs, "walls_from_pushes", lambda *row: tried("hidden_obstacle", *row))
    monkeypatch.setattr(pairs, "patches_from_pushes", lambda *row: tried("friction_patch", *row))
    shake = candidate(150.0, ("camera_shake", -1))
    shake.fit.cost = -150.0
    twos = [two("camera_shake", 300.0), two("friction_patch", 200.0), two("slope", 140.0)]
    names = [name for name in ("push", "hidden_obstacle", "friction_patch") if name != without]
    found = list(
        pairs._in_place_of_pushes(None, fitted(0.0), (shake,), twos, names, lambda fit: None, lambda line: None)
    )
    # One that no single effect leads, and no second patch beside a patch.
    everything = {"hidden_obstacle": [300.0, 200.0], "friction_patch": [300.0]}
    assert asked == {name: rows for name, rows in everything.items() if name != without}
    assert [one.lead for one in found] == ([] if without == "hidden_obstacle" else [201.0])


@pytest.mark.parametrize(
    ("kept", "found", "stays"),
    [
        (None, (50.0, True), False),
        ((50.0, False), (60.0, False), False),
        ((50.0, False), (40.0, False), True),
        ((50.0, False), (60.0, True), True),
        ((50.0, True), (40.0, False), False),
        ((50.0, True), (60.0, True), False),
    ],
)
def test_an_obstacle_that_is_leant_on_takes_no_place_of_one_that_is_hit(monkeypatch, kept, found, stays):
    monkeypatch.setattr(singles, "leans_on", lambda _clip, fit: fit.leans)
    key, (evidence, leans) = ("hidden_obstacle", 0), found
    new: Any = SimpleNamespace(evidence=evidence, leans=leans)
    old: Any = None if kept is None else SimpleNamespace(evidence=kept[0], leans=kept[1])
    fitted: dict = {} if old is None else {key: (old, 1.0)}
    singles._keep(cast(Any, None), fitted, key, new, 2.0)
    assert fitted[key] == ((old, 1.0) if stays else (new, 2.0))


@pytest.mark.parametrize(
    ("gains", "early", "looked_for"),
    [
        ((0.9,), None, False),
        ((), None, False),
        ((0.1, 1.1), None, True),
        ((0.1,), 210.0, True),
        ((0.1,), 190.0, False),
    ],
)
def test_two_effects_are_looked_for_where_a_second_promises_something_beside_the_best(
    monkeypatch, gains, early, looked_for
):
    best, other = candidate(200.0, ("shape", 0)), candidate(90.0, ("drag", 0))
    begun: list[str] = []

    def beside(clip, firsts, names, shown):
        # Beside what does not lead everything promises much.
        return [
            (one, SimpleNamespace(gain=(g if one is best else 1e6) * pairs.HOPE * MISFIT, name="push", target=0))
            for one in firsts
            for g in gains
        ]

    def each(clip, piece, rows, told=None, lines=()):
        begun.append(piece.__name__)
        raise StopIteration

    clip: Any = SimpleNamespace(misfit=lambda fit: MISFIT, crew=SimpleNamespace(each=each))
    monkeypatch.setattr(pairs, "_only_noise", lambda clip, fit: False)
    monkeypatch.setattr(pairs, "_beside", beside)
    twos = () if early is None else (candidate(early, ("shape", 0), ("drag", 0)),)
    try:
        found = pairs.pairs_of(clip, cast(Any, None), (best, other), twos, [], cast(Any, None), 0, lambda line: None)
    except StopIteration:
        found = None
    assert (found is None) == looked_for
    assert bool(begun) == looked_for
    # What was found with more noise stands either way.
    assert found is None or found == twos


@pytest.mark.parametrize(("push", "best", "asked"), [(24.0, 100.0, 0), (26.0, 100.0, 1), (2.0, 2.0, 0), (4.0, 4.0, 1)])
def test_obstacles_and_patches_are_looked_for_in_place_of_pushes_that_lead_by_enough(monkeypatch, push, best, asked):
    seen: list[int] = []

    def nothing(clip, rows, *told):
        seen.append(len(rows))
        return [None] * len(rows)

    monkeypatch.setattr(singles, "walls_from_pushes", nothing)
    monkeypatch.setattr(singles, "patches_from_pushes", nothing)
    base: Any = SimpleNamespace(evidence=-500.0, cost=500.0)
    fitted: Any = {
        (name, 0): (SimpleNamespace(evidence=-500.0 + lead), 0.0) for name, lead in (("shape", best), ("push", push))
    }
    names, nobody = ["hidden_obstacle", "friction_patch"], cast(Any, None)
    singles._in_place_of_pushes(nobody, base, fitted, [], nobody, names, nobody)
    assert seen == [asked, asked]


@pytest.mark.parametrize(
    ("misfit", "smooth", "explained"), [(1.0, 0.5, True), (1.4, 0.5, False), (1.0, 2.0, False), (1.0, 1.2, True)]
)
def test_what_leaves_more_than_noise_or_is_smooth_in_time_is_not_explained(monkeypatch, misfit, smooth, explained):
    monkeypatch.setattr(search, "structure", lambda clip, fit: smooth)
    clip: Any = SimpleNamespace(misfit=lambda fit: misfit)
    base: Any = object()
    assert search._explained(clip, Compared(base, (), (), 0)) is explained


@pytest.mark.parametrize("answers", [True, False])
def test_what_is_explained_but_gives_no_answer_is_looked_into_further(monkeypatch, answers):
    """A fit with states after impacts is the end only where an answer comes of it."""
    shots: Any = object()
    fit: Any = SimpleNamespace(hypothesis=None, z=np.zeros(2))
    silent = {name: lambda *a, **k: fit for name in ("fit", "roam", "settle_noise", "allow_chaos", "allow_slack")}
    clip: Any = SimpleNamespace(settled=None, **silent)

    def further(*rest):
        raise StopIteration

    for name, value in (("_shot", shots), ("_explained", True), ("_of_own_contacts", fit), ("_taken_in", None)):
        monkeypatch.setattr(search, name, lambda *a, value=value: value)
    monkeypatch.setattr(search, "stored_base", lambda *a: fit)
    monkeypatch.setattr(search, "base_space", lambda scene: None)
    monkeypatch.setattr(search, "with_grips", lambda space: None)
    monkeypatch.setattr(search, "singles_of", further)
    asked: list[Any] = []

    def enough(compared):
        asked.append(compared)
        return answers

    nobody = cast(Any, None)

    def compared():
        return search.compare(clip, nobody, nobody, (), (), 0, lambda line: None, enough=enough)

    if answers:
        assert compared() is shots
    else:
        with pytest.raises(StopIteration):
            compared()
    assert asked == [shots]
