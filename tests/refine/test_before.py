"""Masks that are whole though others touch them."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_refine.diagnosis.seen.before import before_others
from mjx_refine.diagnosis.seen.measure import measure
from mjx_refine.observation import Observation
from mjx_refine.view.moments import whole_masks

ROWS, COLUMNS = np.indices((120, 160)) + 0.5
DISC, BOX = 1, 2
CENTRE, RADIUS = (62.3, 60.8), 16.0


def disc(x: float = CENTRE[0], y: float = CENTRE[1], radius: float = RADIUS) -> np.ndarray:
    return np.hypot(COLUMNS - x, ROWS - y) <= radius


def box(left: int, right: int = 110) -> np.ndarray:
    return (np.abs(2 * COLUMNS - left - right) < right - left) & (ROWS > 30) & (ROWS < 90)


def drawn(behind: tuple[int, np.ndarray], ahead: tuple[int, np.ndarray]) -> np.ndarray:
    frame = np.zeros(ROWS.shape, np.uint8)
    for name, mask in (behind, ahead):
        frame[mask] = name
    return frame


def test_a_disc_before_a_box_is_whole_and_the_box_is_not():
    masks = np.stack([drawn((BOX, box(60)), (DISC, disc()))] * 2)
    assert before_others(masks, (DISC, BOX)).whole.tolist() == [[True, False]] * 2


def test_the_moments_of_what_is_before_are_those_of_the_whole():
    masks = drawn((BOX, box(60)), (DISC, disc()))[None]
    told = whole_masks(masks, (DISC, BOX), before=before_others(masks, (DISC, BOX)).whole)[0]
    assert np.isnan(whole_masks(masks, (DISC, BOX))).all()
    assert np.isnan(told[1]).all()
    assert told[0] == pytest.approx([*CENTRE, RADIUS], abs=0.1)


def test_a_straight_border_tells_nothing():
    # The box hides a part of the disc: what is left of that is convex, too, and so is the box.
    masks = drawn((DISC, disc()), (BOX, box(60)))[None]
    assert not before_others(masks, (DISC, BOX)).whole.any()


def test_what_is_before_stays_so_for_as_long_as_pictures_touch():
    bitten, straight = drawn((BOX, box(60)), (DISC, disc())), drawn((BOX, box(77)), (DISC, disc(x=62.0)))
    apart = drawn((BOX, box(95)), (DISC, disc()))
    whole = before_others(np.stack([bitten, straight, apart, straight]), (DISC, BOX)).whole
    assert whole[:, 0].tolist() == [True, True, False, False]


def test_masks_that_each_seem_before_the_other_tell_nothing():
    one = drawn((BOX, box(60)), (DISC, disc()))
    turned = drawn((DISC, disc()), (BOX, (np.abs(COLUMNS - 74) + np.abs(ROWS - 60) < 14)))
    assert before_others(one[None], (DISC, BOX)).whole[0, 0]
    assert before_others(turned[None], (DISC, BOX)).whole[0, 1]
    assert not before_others(np.stack([one, turned]), (DISC, BOX)).whole.any()


def test_what_a_third_one_may_hide_is_not_whole():
    masks = drawn((BOX, box(60)), (DISC, disc()))
    masks[(COLUMNS < 46) & (ROWS > 30) & (ROWS < 90) & (masks == 0)] = 3
    assert before_others(masks[None], (DISC, BOX, 3)).whole[0].tolist() == [False, False, False]


def test_fat_masks_fall_short_by_what_they_cannot_cover():
    wide = 1.0
    fat = drawn((DISC, disc(radius=RADIUS + wide)), (BOX, box(60) & ~disc()))
    masks = drawn((BOX, box(60)), (DISC, (fat != BOX) & disc(radius=RADIUS + wide)))[None]
    found = before_others(masks, (DISC, BOX))
    told = whole_masks(masks, (DISC, BOX), before=found.whole)[0, 0]
    short = np.array([*CENTRE, RADIUS + wide]) - told
    assert short[0] > 0.3
    assert short[2] > 0.2
    assert wide * found.shared[0, 0] == pytest.approx(short, abs=0.12)
    assert not found.shared[0, 1].any()


def test_a_clip_is_measured_with_what_is_before():
    masks = np.stack([drawn((BOX, box(60)), (DISC, disc(x=CENTRE[0] + t))) for t in range(4)])
    flow = np.zeros((3, *masks.shape[1:], 2), np.float32)
    told = measure(Observation(flow=flow, masks=masks, fps=30.0), (1, 0))
    assert told.moments[:, 1, 0] == pytest.approx(CENTRE[0] + np.arange(4), abs=0.1)
    assert np.isnan(told.whole[:, 0]).all()
    assert told.shared is not None
    assert (told.shared[:, 1, 2] > 0.1).all()
    assert not told.shared[:, 0].any()
