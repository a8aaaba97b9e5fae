"""Masks that others or the picture's border cut, and what is predicted of what is left of them."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_refine.diagnosis.seen.before import before_others
from mjx_refine.diagnosis.seen.partly import half_planes, masks_within
from mjx_refine.view.outline import directions
from mjx_refine.view.seen import moments_within, polygon_sums

ROWS, COLUMNS = np.indices((120, 160)) + 0.5
NEAR = 2


def disc(x: float, y: float, radius: float) -> np.ndarray:
    return np.hypot(COLUMNS - x, ROWS - y) <= radius


def left_of(masks: np.ndarray, ids: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    planes = half_planes(masks, ids, NEAR, before_others(masks, ids, NEAR))
    return planes, masks_within(masks, ids, planes)


def within(moments: np.ndarray, plane: np.ndarray, *polygons: np.ndarray) -> np.ndarray:
    """``moments_within`` of one silhouette."""
    told = moments_within(moments[None, None, None], plane[None, None], *(p[None, None, None] for p in polygons))
    return np.asarray(told)[0, 0, 0]


def predicted(x: float, y: float, radius: float, plane: np.ndarray) -> np.ndarray:
    """Moments of what is left of a disc."""
    polygon = np.array([x, y]) + radius * directions(128)
    return within(np.array([x, y, radius]), plane, polygon)


@pytest.mark.parametrize("edge", [66.0, 74.0])
def test_what_is_left_beside_a_straight_border_is_what_is_predicted(edge):
    masks = np.where(disc(60.4, 61.3, 18), 1, 0)
    masks[(np.abs(ROWS - 60) < 30) & (np.abs(COLUMNS - edge - 30) < 30)] = 2
    planes, told = left_of(masks[None], (1, 2))
    assert planes[0, 0] == pytest.approx([1.0, 0.0, edge + 0.5 - NEAR], abs=1e-6)
    assert told[0, 0] == pytest.approx(predicted(60.4, 61.3, 18, planes[0, 0]), abs=0.06)
    assert told[0, 0, 0] < 60.0


def test_what_the_picture_cuts_is_known_within_it():
    masks = np.where(disc(4.3, 50.2, 20), 1, 0)[None]
    planes, told = left_of(masks, (1,))
    assert planes[0, 0].tolist() == [-1.0, 0.0, -NEAR]
    assert told[0, 0] == pytest.approx(predicted(4.3, 50.2, 20, planes[0, 0]), abs=0.1)
    right = np.where(disc(152.0, 50.2, 20), 1, 0)[None]
    assert left_of(right, (1,))[0][0, 0].tolist() == [1.0, 0.0, 160.0 - NEAR]


def test_nothing_is_said_of_a_mask_that_is_whole_or_cut_on_two_sides_or_mostly_hidden():
    whole = np.where(disc(60, 60, 18), 1, 0)[None]
    corner = np.where(disc(4, 4, 20), 1, 0)[None]
    assert np.isnan([left_of(one, (1,)) for one in (whole, corner)]).all()
    hidden = whole.copy()
    hidden[:, :, 47:110] = np.where(hidden[:, :, 47:110] + (np.abs(ROWS[:, 47:110] - 60) < 40) > 0, 2, 0)
    assert np.isnan(left_of(np.concatenate([whole, hidden]), (1, 2))[1][1, 0]).all()


def test_a_line_keeps_its_direction_while_that_leaves_nearly_as_much():
    masks = np.stack([np.where(disc(80, 60, 20), 1, 0)] * 4)
    for frame, angle in zip(masks, np.deg2rad([0.0, 5.0, 9.0, 90.0]), strict=True):
        # What hides it goes around it.
        frame[disc(80, 60, 24) & ((COLUMNS - 80) * np.cos(angle) + (ROWS - 60) * np.sin(angle) > 10)] = 2
    planes = left_of(masks, (1, 2))[0][:, 0]
    assert planes[:3, :2] == pytest.approx(np.tile([1.0, 0.0], (3, 1)))
    assert planes[3, :2] == pytest.approx([0.0, 1.0], abs=1e-9)
    assert left_of(masks[2:], (1, 2))[0][0, 0, 1] > 0.1


def test_what_is_before_others_cuts_them_and_is_not_cut():
    masks = np.where((np.abs(ROWS - 60) < 30) & (np.abs(COLUMNS - 80) < 30), 2, 0)
    masks[disc(50, 60, 16)] = 1
    planes, told = left_of(masks[None], (1, 2))
    assert np.isnan(planes[0, 0]).all()
    assert planes[0, 1] == pytest.approx([-1.0, 0.0, -65.5 - NEAR], abs=1e-6)
    assert told[0, 1] == pytest.approx([(67.5 + 110) / 2, 60.0, np.sqrt(42.5 * 59 / np.pi)], abs=0.6)


SQUARE = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]])


def test_moments_of_a_part_are_those_of_its_polygon():
    area, x, y = polygon_sums(SQUARE)
    plane = np.array([1.0, 0.0, 4.5])
    told = within(np.array([x / area, y / area, np.sqrt(area / np.pi)]), plane, SQUARE)
    assert told == pytest.approx([2.25, 2.0, np.sqrt(18 / np.pi)], rel=1e-5)
    hidden = np.array([[4.0, 1.0], [6.0, 1.0], [6.0, 4.0], [4.0, 4.0]])
    area, x, y = polygon_sums(SQUARE) - polygon_sums(hidden)
    told = within(np.array([x / area, y / area, np.sqrt(area / np.pi)]), plane, SQUARE, hidden)
    left = 18 - 1.5
    centre = (18 * 2.25 - 1.5 * 4.25) / left, (18 * 2 - 1.5 * 2.5) / left
    assert told == pytest.approx([*centre, np.sqrt(left / np.pi)], rel=1e-5)


def test_moments_without_planes_stay_and_nothing_is_told_of_what_lies_beyond():
    whole = np.array([3.0, 2.0, np.sqrt(24 / np.pi)], np.float32)
    np.testing.assert_array_equal(within(whole, np.full(3, np.nan), SQUARE), whole)
    assert np.isnan(within(whole, np.array([1.0, 0.0, -2.0]), SQUARE)).all()
