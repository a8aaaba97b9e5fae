"""What least squares sees of an observation: how far each mask reaches in a few directions, frame by frame."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from mjx_refine.view.moments import BESIDE
from mjx_refine.view.outline import directions

DIRECTIONS = 16
MIN_PIXELS = 12
LEADING = 10
PART = 0.28
"""The gap to the outline, in distances between the first and the tenth pixel centre."""


@dataclasses.dataclass(frozen=True)
class Outlines:
    """Support functions of the observed masks.

    Attributes:
      ids: the masks' ids.
      support: how far mask i reaches in direction d in frame t [px]; NaN where it cannot be known, since the border or
        another object cuts the outline there or the mask is missing or tiny.
      centre: centroids (x, y) [px]; NaN where the mask is missing.
      area: [px^2].
    """

    ids: tuple[int, ...]
    support: Float[np.ndarray, "frames masks directions"]
    centre: Float[np.ndarray, "frames masks 2"]
    area: Float[np.ndarray, "frames masks"]


def outlines(masks: Int[np.ndarray, "frames height width"], count: int = DIRECTIONS, near: int = BESIDE) -> Outlines:
    """Measures every mask in every frame; what the border or another mask comes within ``near`` pixels of, it may cut."""
    ids = [int(i) for i in np.unique(masks) if i != 0]
    length = len(masks)
    support = np.full((length, len(ids), count), np.nan)
    centre = np.full((length, len(ids), 2), np.nan)
    area = np.zeros((length, len(ids)))
    for t, frame in enumerate(masks):
        for j, i in enumerate(ids):
            measured = _measure(frame, i, directions(count), near)
            if measured is not None:
                area[t, j], centre[t, j], support[t, j] = measured
    return Outlines(tuple(ids), support, centre, area)


def _measure(frame: np.ndarray, i: int, normals: np.ndarray, near: int):
    """(area, centroid, support) of one mask in one frame, or None where it is absent."""
    height, width = frame.shape
    box = _box(frame, i)
    if box is None:
        return None
    # Only the mask's surroundings are looked at.
    top, left = (max(side.start - near, 0) for side in box)
    part = frame[top : box[0].stop + near, left : box[1].stop + near]
    mask = part == i
    area = int(np.count_nonzero(mask))
    rows, columns = np.nonzero(mask)
    centre = np.array([columns.mean() + left + 0.5, rows.mean() + top + 0.5])
    if area < MIN_PIXELS:
        return area, centre, np.full(len(normals), np.nan)
    along = np.stack([columns + left + 0.5, rows + top + 0.5], -1) @ normals.T
    extreme = along.argmax(0)
    reach = along.max(0) + _beyond(along, normals)
    others = ndimage.maximum_filter(np.where(mask, 0, part), size=2 * near + 1)[rows[extreme], columns[extreme]] > 0
    rows, columns = rows[extreme] + top, columns[extreme] + left
    cut = (rows < near) | (columns < near) | (rows >= height - near) | (columns >= width - near) | others
    return area, centre, np.where(cut, np.nan, reach)


def _box(frame: Int[np.ndarray, "height width"], i: int) -> tuple[slice, slice] | None:
    """Rows and columns that hold mask ``i``, or None where it is absent."""
    rows = np.nonzero((frame == i).any(1))[0]
    if len(rows) == 0:
        return None
    within = slice(int(rows[0]), int(rows[-1]) + 1)
    columns = np.nonzero((frame[within] == i).any(0))[0]
    return within, slice(int(columns[0]), int(columns[-1]) + 1)


def _beyond(along: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """How far an outline lies on average beyond the last pixel centre inside, by direction [px].

    Along an axis or a diagonal centres lie in rows, and the outline half a row's distance beyond the last. Elsewhere they
    are as good as scattered: the gap is a part of the distance between the first and the tenth, small where the outline
    is flat, wide at a corner. With a cap of area c s^p cut off at depth s (p = 1.5 if round), E gap_k = (k / c)^(1/p)
    about: gap_1 = 0.24 (gap_10 - gap_1); corners want 0.3.
    """
    leading = np.partition(along, -LEADING, axis=0)[-LEADING:]
    scattered = np.minimum(PART * (leading.max(0) - leading.min(0)), 1.0)
    size = np.abs(normals)
    lattice = np.where(size.min(-1) < 1e-6, 0.5, np.sqrt(0.125))
    regular = (size.min(-1) < 1e-6) | (np.abs(size[:, 0] - size[:, 1]) < 1e-6)
    return np.where(regular, np.maximum(lattice, scattered), scattered)


POINTS = 12
"""Pixels of each mask at which the flow is compared."""


def flow_points(
    masks: Int[np.ndarray, "frames height width"],
    flow: Float[np.ndarray, "intervals height width 2"],
    ids: tuple[int, ...],
) -> tuple[Float[np.ndarray, "frames masks points 2"], Float[np.ndarray, "frames masks points 2"]]:
    """(pixel centres, observed flow [px/frame]) at points spread over the inside of every mask.

    Flow is NaN where there is none to compare: no mask, a tiny one, not measured, the last frame.
    """
    pixels = np.zeros((len(masks), len(ids), POINTS, 2))
    seen = np.full_like(pixels, np.nan)
    for t in range(len(flow)):
        for j, i in enumerate(ids):
            box = _box(masks[t], i)
            if box is None:
                continue
            # Flow is measured worst at the edge.
            inside = ndimage.binary_erosion(masks[t][box] == i, iterations=2)
            rows, columns = np.nonzero(inside & np.isfinite(flow[t][box]).all(-1))
            if len(rows) < POINTS:
                continue
            chosen = np.linspace(0, len(rows) - 1, POINTS + 2).astype(int)[1:-1]
            rows, columns = rows[chosen] + box[0].start, columns[chosen] + box[1].start
            pixels[t, j] = np.stack([columns + 0.5, rows + 0.5], -1)
            seen[t, j] = flow[t, rows, columns]
    return pixels, seen


def flow_of_objects(
    flow: tuple[np.ndarray, np.ndarray] | None, columns: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Pixels and flow of each object's mask; flow is NaN for an object without one."""
    if flow is None:
        return np.zeros(0), None
    pixels, seen = flow
    chosen = [max(j, 0) for j in columns]
    lost = np.array([j < 0 for j in columns])
    return pixels[:, chosen], np.where(lost[None, :, None, None], np.nan, seen[:, chosen])
