"""What least squares sees of an observation: how far each mask reaches in a few directions, frame by frame."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from mjx_refine.view.outline import directions

DIRECTIONS = 16
MIN_PIXELS = 12


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


def outlines(masks: Int[np.ndarray, "frames height width"], count: int = DIRECTIONS) -> Outlines:
    """Measures every mask in every frame."""
    ids = [int(i) for i in np.unique(masks) if i != 0]
    length = len(masks)
    support = np.full((length, len(ids), count), np.nan)
    centre = np.full((length, len(ids), 2), np.nan)
    area = np.zeros((length, len(ids)))
    for t, frame in enumerate(masks):
        for j, i in enumerate(ids):
            measured = _measure(frame, i, directions(count))
            if measured is not None:
                area[t, j], centre[t, j], support[t, j] = measured
    return Outlines(tuple(ids), support, centre, area)


def _measure(frame: np.ndarray, i: int, normals: np.ndarray):
    rows, columns = np.nonzero(frame == i)
    if len(rows) == 0:
        return None
    centre = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
    if len(rows) < MIN_PIXELS:
        return len(rows), centre, np.full(len(normals), np.nan)
    height, width = frame.shape
    rim = ndimage.binary_erosion(frame == i, border_value=0)
    rows, columns = np.nonzero((frame == i) & ~rim)
    points = np.stack([columns + 0.5, rows + 0.5], -1)
    along = points @ normals.T
    extreme = along.argmax(0)
    # Half a pixel: an edge lies on average that far beyond the last centre inside, across the nearer axis.
    reach = along.max(0) + 0.5 * np.abs(normals).max(-1)
    others = ndimage.maximum_filter(np.where(frame == i, 0, frame), size=5)
    rows, columns = rows[extreme], columns[extreme]
    cut = (rows < 2) | (columns < 2) | (rows >= height - 2) | (columns >= width - 2) | (others[rows, columns] > 0)
    return int(np.count_nonzero(frame == i)), centre, np.where(cut, np.nan, reach)
