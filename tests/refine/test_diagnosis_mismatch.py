"""A scene that is not its clip's says nothing."""

from __future__ import annotations

import dataclasses
import math

import pytest
from test_diagnose_report import made_up

from mjx_refine.diagnosis.mismatch import MATCHES, matched
from mjx_refine.diagnosis.result import UNKNOWN


def _reaching(before: float, after: float):
    found = made_up()
    return dataclasses.replace(found, gap=dataclasses.replace(found.gap, iou_before=before, iou_after=after))


@pytest.mark.parametrize(("before", "after"), [(0.2, 0.9), (0.9, 0.2), (MATCHES, 0.0), (math.nan, math.nan)])
def test_a_scene_that_replays_its_clip_is_diagnosed(before, after):
    found = _reaching(before, after)
    assert matched(found) is found


def test_nothing_is_named_where_neither_scene_replays_the_clip():
    found = _reaching(0.37, 0.28)
    told = matched(found)
    assert told.verdict.effects == UNKNOWN
    assert "Cannot tell" in told.verdict.sentence
    assert "0.37" in told.verdict.sentence
    assert told.scene == found.base
    assert (told.gap.after, told.gap.closed, told.gap.iou_after) == (found.gap.before, 0.0, 0.37)
    assert max(one.probability for one in told.candidates) < 0.5
    assert told.remaining == found.residual
