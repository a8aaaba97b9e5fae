"""Effects that ordinary numbers imitate, begun from the given scene."""

from __future__ import annotations

import pytest
from test_diagnosis_tempered import ROLL, quiet, started_with

from mjx_refine.diagnosis.search import given
from mjx_refine.diagnosis.search.given import GO_ON, far_from_given


@pytest.fixture(scope="module")
def rolled():
    """A flight that a rolled camera filmed."""
    clip, base, shown = started_with(ROLL)
    return clip, base, shown(base)


def test_a_rolled_camera_is_found_from_the_given_scene(rolled):
    clip, base, view = rolled
    lines: list[str] = []
    found = dict(far_from_given(clip, base, ["camera_roll", "wind", "magnus"], view, lines.append))
    assert lines == ["from the given scene"]
    # What costs far more after the first steps does not go on.
    assert set(found) == {("camera_roll", -1)}
    fit = found["camera_roll", -1]
    assert fit.evidence > base.evidence + 30
    assert fit.hypothesis.values(fit.z[None], 0)[0, 0] == pytest.approx(7.0, abs=1.5)


def test_only_the_most_promising_of_what_is_imitated_go_on(rolled, monkeypatch):
    clip, base, view = rolled
    monkeypatch.setattr(given, "CLOSE", 1e9)
    # A wind is nothing that ordinary numbers imitate.
    found = far_from_given(clip, base, ["camera_roll", "wind", "magnus"], view, quiet)
    assert set(dict(found)) == {("camera_roll", -1), ("magnus", 0)}
    found = far_from_given(clip, base, ["camera_roll", "slope", "mask_bias", "magnus"], view, quiet)
    assert len(found) == GO_ON
    assert ("camera_roll", -1) in dict(found)


def test_a_base_model_that_leaves_noise_is_enough(rolled, monkeypatch):
    clip, base, view = rolled
    monkeypatch.setattr(given, "LEAVES", 2 * clip.misfit(base))
    lines: list[str] = []
    assert far_from_given(clip, base, ["camera_roll"], view, lines.append) == []
    assert lines == []
