"""Which masks are whole though others touch them, since they are before what they touch."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from mjx_refine.view.moments import BESIDE
from mjx_refine.view.outline import directions

DIRECTIONS = 64
"""In which a mask's convex hull is told."""

DEEP, ENOUGH = 2.5, 4
"""A mask is before another where so many of its pixels lie this deep within the other's convex hull [px]. What spheres, boxes
and cylinders show is convex, so they lie within the other's silhouette, too, and hide it there; the random half pixel of a
border's noise does not reach so deep."""

ACROSS = 3
"""How far from a border the smoothed mask's gradient is counted [px]."""


class Before(NamedTuple):
    """Of masks that are before all that come near them.

    Attributes:
      whole: whether a mask is one.
      ahead: by frame, pairs of ids of which the first is known to be before the second.
      shared: by how much its centroid (x, y) and its equivalent radius fall short of those of a mask that is too fat all
        around, for each pixel by which masks are too fat: where it borders on another mask it cannot be wider [px/px]; 0
        elsewhere.
    """

    whole: Bool[np.ndarray, "frames ids"]
    ahead: list[set[tuple[int, int]]]
    shared: Float[np.ndarray, "frames ids 3"]


def before_others(masks: Int[np.ndarray, "frames height width"], ids: tuple[int, ...], near: int = BESIDE) -> Before:
    """Which masks hide a part of all others that come within ``near`` pixels of them, and at least of one.

    Of two convex bodies that do not overlap one is before the other wherever both are in sight, so that nothing hides the
    former; and that stays so for as long as their pictures touch, even where a border is too straight to tell.
    """
    near_by = [neighbours(frame, ids, near) for frame in masks]
    pairs = sorted({pair for one in near_by for pair in one})
    told = {pair: _ahead(masks, pair, np.array([pair in one for one in near_by])) for pair in pairs}
    ahead = [{pair for pair in pairs if told[pair][t]} for t in range(len(masks))]
    whole = np.zeros((len(masks), len(ids)), bool)
    shared = np.zeros((*whole.shape, 3))
    for t, frame in enumerate(masks):
        for j, i in enumerate(ids):
            others = [other for one, other in near_by[t] if one == i]
            whole[t, j] = bool(others) and all((i, other) in ahead[t] for other in others)
            if whole[t, j]:
                shared[t, j] = _shared(frame == i, np.isin(frame, others))
    return Before(whole, ahead, shared)


def neighbours(frame: np.ndarray, ids: tuple[int, ...], near: int) -> set[tuple[int, int]]:
    """Pairs of masks that come within ``near`` pixels of one another, either way round."""
    found = set()
    for i, box in enumerate(ndimage.find_objects(frame), 1):
        if box is None or i not in ids:
            continue
        part = frame[tuple(slice(max(side.start - near, 0), side.stop + near) for side in box)]
        around = np.asarray(ndimage.maximum_filter(part == i, size=2 * near + 1)) & (part != i)
        found |= {pair for other in np.unique(part[around]) if other for pair in ((i, int(other)), (int(other), i))}
    return found


def _ahead(
    masks: np.ndarray, pair: tuple[int, int], touching: Bool[np.ndarray, "frames"]
) -> Bool[np.ndarray, "frames"]:
    """Frames in which the first of a pair is known to be before the second; none where masks tell either of each."""
    one, other = pair
    told = np.zeros(len(masks), bool)
    runs, count = ndimage.label(touching)
    for run in range(1, count + 1):
        frames = np.flatnonzero(runs == run)
        ahead, behind = (any(_hides(masks[t], *both) for t in frames) for both in ((one, other), (other, one)))
        told[frames] = ahead and not behind
    return told


def _hides(frame: np.ndarray, one: int, other: int) -> bool:
    """Whether enough pixels of one mask lie deep within the convex hull of another."""
    rows, columns = (np.flatnonzero((frame == other).any(axis)) for axis in (1, 0))
    part = frame[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    normals = directions(DIRECTIONS)[:, ::-1].T
    reach = (np.argwhere(part == other) @ normals).max(0)
    inside = np.argwhere(part == one)
    return bool(np.count_nonzero((reach - inside @ normals).min(1) > DEEP) >= ENOUGH) if len(inside) else False


def _shared(mask: Bool[np.ndarray, "rows columns"], others: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3"]:
    """``Before.shared`` of one mask."""
    # The gradient of a smoothed mask, summed across its border, is one for each pixel of the border's length.
    length = ndimage.gaussian_gradient_magnitude(mask.astype(float), 1.0, mode="nearest")
    length[~np.asarray(ndimage.binary_dilation(others, iterations=ACROSS))] = 0.0
    rows, columns = np.indices(mask.shape)
    row, column = ndimage.center_of_mass(mask)
    area = float(mask.sum())
    away = [float((length * offset).sum()) / area for offset in (columns - column, rows - row)]
    return np.array([*away, float(length.sum()) / (2.0 * math.sqrt(math.pi * area))])
