"""Masks that others or the picture's border cut: half planes within which they are all that there is of their object."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from mjx_refine.diagnosis.before import Before, neighbours
from mjx_refine.view.outline import directions

LINES = 32
"""Directions in which a line is drawn beside what may hide a part of a mask."""

LEAST, PART = 100, 0.4
"""Pixels of a mask, and part of its largest area in the clip, that must be left within the half plane: of less, the border's
noise moves the centroid by more than it does a whole mask's."""

STAYS = 0.85
"""A line keeps its direction from frame to frame as long as it leaves this part of what the best one leaves: what is off smoothly
should stay so."""


def half_planes(
    masks: Int[np.ndarray, "frames height width"], ids: tuple[int, ...], near: int, before: Before
) -> Float[np.ndarray, "frames ids 3"]:
    """(normal x, normal y, offset) [px] of the half plane n . p <= o within which a mask is its object's whole silhouette.

    Whatever comes within ``near`` pixels of the mask, and is not known to be behind it, lies beyond by as much, all of it; so
    does the border of the picture where that cuts the mask. NaN where nothing cuts it, and where too little is left.
    """
    planes = np.full((len(masks), len(ids), 3), np.nan)
    most = [max((int(np.count_nonzero(frame == i)) for frame in masks), default=0) for i in ids]
    last: dict[int, np.ndarray] = {}
    for t, frame in enumerate(masks):
        near_by, drawn = neighbours(frame, ids, near), last
        last = {}
        for j, i in enumerate(ids):
            if before.whole[t, j] or not (frame == i).any():
                continue
            others = [other for one, other in near_by if one == i and (i, other) not in before.ahead[t]]
            found = _half_plane(frame == i, np.isin(frame, others), near, drawn.get(i))
            if found is not None and found[1] >= max(LEAST, PART * most[j]):
                planes[t, j] = found[0]
                last[i] = found[0][:2]
    return planes


def _half_plane(
    mask: Bool[np.ndarray, "height width"],
    others: Bool[np.ndarray, "height width"],
    near: int,
    last: Float[np.ndarray, "2"] | None,
) -> tuple[Float[np.ndarray, "3"], int] | None:
    """The half plane that leaves most of a mask, and how many pixels; None where nothing cuts it, or borders on two sides.

    ``last``: the normal that was drawn in the frame before, if any; nearly as good is good enough for it.
    """
    points = np.argwhere(mask)[:, ::-1] + 0.5
    low, high = points.min(0) - near, np.array(mask.shape[::-1]) - near - points.max(0)
    cut = [np.array(n) for n, gap in zip(((-1, 0), (0, -1), (1, 0), (0, 1)), (*low, *high), strict=True) if gap < 0]
    if len(cut) > 1 or not (cut or others.any()):
        return None
    normals = np.array(cut) if cut else directions(LINES)
    offset = np.full(len(normals), np.inf)
    if cut:
        offset[0] = max(float(normals[0] @ mask.shape[::-1]), 0.0) - near
    if others.any():
        edge = others & ~np.asarray(ndimage.binary_erosion(others))
        offset = np.minimum(offset, ((np.argwhere(edge)[:, ::-1] + 0.5) @ normals.T).min(0) - near)
    left = (points @ normals.T <= offset).sum(0)
    best = int(left.argmax())
    if last is not None:
        same = int((normals @ last).argmax())
        best = same if normals[same] @ last > 1 - 1e-9 and left[same] >= STAYS * left[best] else best
    return np.array([*normals[best], offset[best]]), int(left[best])


def masks_within(
    masks: Int[np.ndarray, "frames height width"], ids: tuple[int, ...], planes: Float[np.ndarray, "frames ids 3"]
) -> Float[np.ndarray, "frames ids 3"]:
    """Centroid and equivalent radius of what of each mask lies within its half plane [px]; NaN where there is none."""
    result = np.full(planes.shape, np.nan)
    for t, j in np.argwhere(np.isfinite(planes[..., 2])):
        points = np.argwhere(masks[t] == ids[j])[:, ::-1] + 0.5
        # Pixels that the line crosses count by how much of them is within, about.
        part = np.clip(planes[t, j, 2] - points @ planes[t, j, :2] + 0.5, 0.0, 1.0)
        area = float(part.sum())
        result[t, j] = [*(part @ points / area), np.sqrt(area / np.pi)]
    return result
