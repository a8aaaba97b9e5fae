"""Gaps between masks of which one hides part of the other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from mjx_refine.diagnosis.seen import gaps
from mjx_refine.diagnosis.seen.gaps import gap_between
from mjx_refine.diagnosis.seen.measure import measure
from mjx_refine.observation import Observation

FRAMES, HEIGHT, WIDTH = 10, 90, 160


def _disc(x: float, y: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return (columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2 < radius**2


def _thinner(mask: np.ndarray, by: float) -> np.ndarray:
    return np.asarray(ndimage.distance_transform_edt(mask)) > by if by else mask


def _passing(by: float, hides: bool = True, speed: float = 3.0) -> np.ndarray:
    """A disc that goes by before another, both masks too thin by so much [px]."""
    masks = np.zeros((FRAMES, HEIGHT, WIDTH), np.int32)
    for t in range(FRAMES):
        near, far = _disc(50 + speed * t, 55, 24), _disc(90, 40 if hides else 4, 26)
        masks[t][_thinner(far & ~near, by)] = 2
        masks[t][_thinner(near, by)] = 1
    return masks


@pytest.mark.parametrize("by", [2.0, 4.0, 7.0])
def test_thin_masks_of_which_one_hides_the_other_are_apart_by_twice_as_much(by):
    assert gap_between(_passing(by)) == pytest.approx(2 * by, abs=1.5)


def test_masks_as_they_are_touch():
    assert gap_between(_passing(0.0)) == 0.0


def test_what_passes_by_hides_nothing():
    assert gap_between(_passing(0.0, hides=False)) == 0.0
    assert gap_between(_passing(4.0, hides=False)) == 0.0


def test_what_stays_as_it_is_may_stand_side_by_side():
    assert gap_between(_passing(4.0, speed=0.0)) == 0.0


def test_a_single_mask_has_no_gap():
    assert gap_between(np.minimum(_passing(4.0), 1)) == 0.0


def _covered(by: float, hides: bool = True) -> np.ndarray:
    """A small disc that goes behind another, both masks too thin by so much [px]; or shrinks beside it."""
    masks = np.zeros((2 * FRAMES, HEIGHT, WIDTH), np.int32)
    for t in range(2 * FRAMES):
        near = _disc(90, 45, 26)
        far = _disc(56 + 0.7 * t, 45 + 0.3 * t, 9) if hides else _disc(90, 3 + 0.3 * t, 8)
        masks[t][_thinner(far & ~near, by)] = 2
        masks[t][_thinner(near, by)] = 1
    return masks


@pytest.mark.parametrize("by", [2.0, 3.0])
def test_what_loses_area_while_it_stays_as_far_apart_is_hidden(by, monkeypatch):
    assert gap_between(_covered(by)) == pytest.approx(2 * by, abs=1.5)
    # Its outline is too short to tell of it.
    monkeypatch.setattr(gaps, "HELD", 99)
    assert gap_between(_covered(by)) == 0.0


def test_what_comes_nearer_is_not_hidden():
    assert gap_between(_covered(2.0, hides=False)) == 0.0


def _nudged(by: float) -> np.ndarray:
    """A small disc before the rim of a large one, both masks too thin by so much [px]."""
    masks = np.zeros((FRAMES, HEIGHT, WIDTH), np.int32)
    for t in range(FRAMES):
        near, far = _disc(112 + 0.4 * t, 45, 8), _disc(80, 45, 32)
        masks[t][_thinner(far & ~near, by)] = 2
        masks[t][_thinner(near, by)] = 1
    return masks


@pytest.mark.parametrize("by", [2.0, 4.0])
def test_a_bite_tells_of_a_gap_however_short_it_is(by, monkeypatch):
    # Longer outlines than these tell of it by themselves.
    monkeypatch.setattr(gaps, "LEAST_PIXELS", 99)
    assert gap_between(_nudged(by)) == pytest.approx(2 * by, abs=1.5)
    assert gap_between(_nudged(0.0)) == 0.0
    monkeypatch.setattr(gaps, "BITTEN", 99)
    assert gap_between(_nudged(by)) == 0.0


def test_outlines_along_a_gap_are_not_measured():
    masks = _passing(4.0)
    flow = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32)
    measured = measure(Observation(flow, masks, 30.0), (0, 1))
    # In the last frame the near disc, at (77, 55), hides the lower part of the far one, at (90, 40).
    below, above = 4, 12
    assert np.isnan(measured.reach[-1, 1, below])
    assert np.isfinite(measured.reach[-1, 1, above])
    assert np.isnan(measured.whole[-1]).all()
    assert measured.reach.shape[2] == 16
