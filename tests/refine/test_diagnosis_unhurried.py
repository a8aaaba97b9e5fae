"""Effects that act all along, fitted by stages from the given scene."""

from __future__ import annotations

import dataclasses

import pytest
from test_diagnosis import FLIGHT
from test_diagnosis_tempered import ROLL, quiet, started_with

from mjx_refine.diagnosis.fits.candidates import Candidate, Compared
from mjx_refine.diagnosis.search import compare as search
from mjx_refine.diagnosis.search import given
from mjx_refine.diagnosis.search.unhurried import END, unhurried
from mjx_refine.effects import catalogue

NAMES = ["camera_roll", "push", "dropped_frames"]


@pytest.fixture(scope="module")
def rolled():
    """A flight that a rolled camera filmed."""
    return started_with(ROLL)


@pytest.fixture(scope="module")
def found(rolled):
    """What is found of it, and the lines that were told."""
    clip, base, shown = rolled
    lines: list[str] = []
    return unhurried(clip, base, NAMES, shown(base), lines.append), lines


def test_what_acts_at_one_moment_is_not_among_them():
    steady = {name for name, kind in catalogue().items() if kind.steady}
    assert {"wind", "drag", "slope", "camera_roll", "rolling_shutter"} <= steady
    assert not steady & {"push", "hidden_obstacle", "friction_patch", "dropped_frames", "camera_shake"}


def test_a_rolled_camera_is_found_by_stages(rolled, found):
    _clip, base, _ = rolled
    (better, fits), lines = found
    assert lines == ["from the given scene, by stages"]
    ((key, fit),) = fits
    assert key == ("camera_roll", -1)
    assert better.evidence >= base.evidence
    assert fit.evidence > better.evidence + 30
    assert fit.hypothesis.values(fit.z[None], 0)[0, 0] == pytest.approx(7.0, abs=1.5)


def test_only_the_cheapest_go_on_and_noise_stays_as_it_is(rolled):
    clip, base, shown = rolled
    noise = clip.settled.noise
    _, fits = unhurried(clip, base, ["camera_roll", "slope", "mask_bias", "rolling_shutter"], shown(base), quiet)
    assert len(fits) == END
    assert fits[0][0] == ("camera_roll", -1)
    assert clip.settled.noise is noise


def taken_in(rolled, lead: float, told=quiet):
    """What is said of effects that states after impacts may have taken in, where the best effect leads by so much."""
    clip, base, shown = rolled
    shots = Compared(base, (Candidate(base, lead, 0.0),), (), 0)
    return search._taken_in(clip, base, shots, NAMES, None, shown, 0, told)


def test_what_leads_with_states_after_impacts_is_enough(rolled):
    lines: list[str] = []
    assert taken_in(rolled, search.CLEAR + 1, lines.append) is None
    assert lines == []


def test_a_base_model_that_leaves_noise_has_taken_nothing_in(rolled, monkeypatch):
    clip, base, _ = rolled
    monkeypatch.setattr(given, "LEAVES", 2 * clip.misfit(base))
    lines: list[str] = []
    assert taken_in(rolled, 0.0, lines.append) is None
    assert lines == []


@pytest.mark.parametrize("lead", [0.0, 100.0])
def test_what_was_taken_in_counts_where_it_leads_with_such_states_too(rolled, monkeypatch, lead):
    begun = []

    def shot(clip, base, found, *rest):
        begun.append(found[0].names)
        return Compared(base, (Candidate(base, lead, 0.0),), (), 0)

    monkeypatch.setattr(given, "LEAVES", 0.0)
    monkeypatch.setattr(search, "_shot", shot)
    again = taken_in(rolled, 0.0)
    assert begun == [("camera_roll",)]
    assert (again is not None) == (lead > search.CLEAR)


@pytest.mark.parametrize("answers", [True, False])
def test_noise_is_as_it_was_where_what_was_taken_in_gives_no_answer(rolled, monkeypatch, answers):
    """The hypotheses that are told are judged with the noise that they were found with."""
    clip, base, _ = rolled
    kept = clip.settled
    first, second = (Compared(base, (), (), k) for k in range(2))
    noises = [kept.noise.times(2.0), kept.noise.times(3.0)]

    def found(clip, at, which):
        clip.settled = dataclasses.replace(kept, noise=noises[at])
        return which

    monkeypatch.setattr(search, "stored_base", lambda *a: base)
    monkeypatch.setattr(search, "_of_own_contacts", lambda clip, base: base)
    monkeypatch.setattr(search, "_explained", lambda *a: True)
    monkeypatch.setattr(search, "_shot", lambda clip, *a: found(clip, 0, first))
    monkeypatch.setattr(search, "_taken_in", lambda clip, *a: found(clip, 1, second))
    for name in ("settle_noise", "allow_chaos", "allow_slack"):
        monkeypatch.setattr(clip, name, lambda *a: 0)
    monkeypatch.setattr(clip, "fit", lambda *a: base)
    monkeypatch.setattr(clip, "roam", lambda *a: base)
    told = search.compare(clip, FLIGHT, None, (0,), (), 0, quiet, enough=lambda compared: compared is first or answers)
    assert told is (second if answers else first)
    assert clip.settled.noise is noises[answers]
    clip.settled = kept
