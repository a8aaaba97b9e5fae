"""Straight borders at which masks stop while their objects go on."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_refine.diagnosis.seen import cuts
from mjx_refine.diagnosis.seen.cuts import cut_places

ROWS, COLUMNS = np.mgrid[:120, :160]


def falling(frames: int = 12, hidden=None, step=(0.0, 5.0)) -> np.ndarray:
    """Masks of a disc that moves by ``step`` (right, down) a frame, and is not seen in ``hidden`` (left, top, right, bottom)."""
    masks = np.zeros((frames, 120, 160), np.uint8)
    for k in range(frames):
        x, y = 70 + step[0] * k, 30 + step[1] * k
        masks[k] = np.hypot(COLUMNS - x, ROWS - y) < 15
    if hidden is not None:
        left, top, right, bottom = hidden
        masks[:, top:bottom, left:right] = 0
    return masks


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("upwards", [False, True])
def test_a_border_that_a_mask_runs_into_is_found(turned, upwards):
    masks = falling(hidden=(40, 70, 110, 100))[:9]
    masks = masks[:, ::-1] if upwards else masks
    masks = masks.transpose(0, 2, 1) if turned else masks
    box = cut_places(masks)[0]
    border = 49 if upwards else 70
    sides = (box.left, box.right) if turned else (box.top, box.bottom)
    assert abs((sides[1] if upwards else sides[0]) - border) <= 1.5
    across = (box.top, box.bottom) if turned else (box.left, box.right)
    # Where the disc would be, and nothing that is ever seen.
    assert across[0] < 60
    assert across[1] > 80
    left, top, right, bottom = (int(v) for v in box)
    assert not masks[:, top + 1 : bottom - 1, left:right].any()


def test_what_is_whole_is_cut_nowhere():
    assert cut_places(falling()) == ()


def test_what_slides_along_a_floor_is_cut_nowhere():
    masks = np.zeros((12, 120, 160), np.uint8)
    for k in range(12):
        masks[k, 60:90, 20 + 6 * k : 60 + 6 * k] = 1
    assert cut_places(masks) == ()


def test_what_another_object_hides_is_hidden_by_nothing_else():
    masks = falling()[:9]
    masks[:, 70:, :] = 2
    assert cut_places(masks) == ()


def test_what_hides_may_end_where_a_mask_goes_by(monkeypatch):
    # In one frame the disc is seen beyond the line, right of the corner.
    masks = falling(hidden=(20, 70, 69, 118), step=(-2.0, 5.0))[:9]
    beyond = masks[:, 70:].any((0, 1))
    assert 0 < np.count_nonzero(beyond) < 8
    box = cut_places(masks)[0]
    assert abs(box.top - 70) <= 1.5
    assert abs(box.right - 69) <= 1.5
    monkeypatch.setattr(cuts, "MOST_OF", 1.0)
    assert cut_places(masks) == ()
