"""A scene that is not its clip's says nothing."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_diagnose_report import made_up
from test_diagnosis import FLIGHT, clip_of

from mjx_refine.diagnosis.answer import mismatch
from mjx_refine.diagnosis.answer.mismatch import FAR, MATCHES, matched, moved_by
from mjx_refine.diagnosis.diagnose import diagnose
from mjx_refine.diagnosis.result import UNKNOWN


def _reaching(before: float, after: float):
    found = made_up()
    return dataclasses.replace(found, gap=dataclasses.replace(found.gap, iou_before=before, iou_after=after))


@pytest.mark.parametrize(("before", "after"), [(0.2, 0.9), (0.9, 0.2), (MATCHES, 0.0), (math.nan, math.nan)])
def test_a_scene_that_replays_its_clip_is_diagnosed(before, after):
    found = _reaching(before, after)
    assert matched(found, FAR) is found


def test_nothing_is_named_where_neither_scene_replays_the_clip():
    found = _reaching(0.37, 0.28)
    told = matched(found, 0.5)
    assert told.verdict.effects == UNKNOWN
    assert "Cannot tell" in told.verdict.sentence
    assert "0.37" in told.verdict.sentence
    assert told.scene == found.base
    assert (told.gap.after, told.gap.closed, told.gap.iou_after) == (found.gap.before, 0.0, 0.37)
    assert max(one.probability for one in told.candidates) < 0.5
    assert told.remaining == found.residual


def test_nothing_is_named_where_only_another_scene_replays_the_clip():
    found = _reaching(0.82, 0.83)
    told = matched(found, FAR + 4.0)
    assert told.verdict.effects == UNKNOWN
    assert "Cannot tell" in told.verdict.sentence
    assert "10.0 times" in told.verdict.sentence
    assert told.scene == found.base


def test_how_far_numbers_moved_is_of_the_fit_that_moves_them_least_and_of_ordinary_ones():
    def fit(*z) -> Any:
        return SimpleNamespace(z=np.array(z), hypothesis=SimpleNamespace(space=SimpleNamespace(dimension=2)))

    assert moved_by([fit(3.0, 4.0)]) == pytest.approx(math.sqrt(12.5))
    assert moved_by([fit(3.0, 4.0), fit(1.0, 1.0, 90.0)]) == pytest.approx(1.0)


@pytest.fixture
def moved_at_once(monkeypatch):
    """Any move of ordinary numbers is that of a scene of another clip."""
    monkeypatch.setattr(mismatch, "AT_ONCE", 0.0)
    monkeypatch.setattr(mismatch, "FAR", 0.0)


def test_no_effect_is_looked_for_in_a_scene_that_the_base_model_leaves_far_behind(moved_at_once):
    lines: list[str] = []
    found = diagnose(FLIGHT, clip_of(FLIGHT, 12), threads=1, told=lines.append)
    assert lines == ["base model", "held-out frames", "a force without a name", "report"]
    assert found.verdict.effects == UNKNOWN
    assert "Cannot tell" in found.verdict.sentence
    assert found.candidates == ()


def test_without_masks_a_scene_is_taken_as_it_is_given(moved_at_once):
    lines: list[str] = []
    diagnose(FLIGHT, dataclasses.replace(clip_of(FLIGHT, 12), masks=None), threads=1, told=lines.append)
    assert len(lines) > 4
