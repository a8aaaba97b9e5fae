"""Masks that are systematically too fat or too thin."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.effects.kind import EffectKind, EffectParameter, OutlineView

SWEEPS = 6
"""Over all scales. Corners of a square 80 px wide that loses 7 px on every side, turned anyhow, are then off by 0.3 px in 128
directions, most of it because no direction is quite an edge's normal; taking the same off everywhere errs by 2.8 px."""

BLOCK = 256
"""Outlines that are swept together: what a core's cache holds."""


class MaskBias(EffectKind):
    """Masks reach ``width`` pixels too far on every side.

    What grows keeps its corners' tangents, rounded; what shrinks loses more at its corners than at its edges, by which
    directions must be fine to tell (``OutlineView``).
    """

    name = "mask_bias"
    sentence = "the masks are systematically too fat or too thin"
    experiment = "Compare a mask with the picture by eye; a true size changes with distance, a bias does not."
    channel = "perception"
    drawn = True
    imitated = True
    steady = True
    parameters = (EffectParameter("width", "px", 2.0, -100.0, 100.0),)

    def outline(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        return width_change(view.reach, values[:, 0])

    def overdrawn(self, values: np.ndarray) -> np.ndarray | None:
        return np.maximum(values[:, 0], 0.0)

    def directions(self, values: np.ndarray) -> int:
        return 128 if (values[:, 0] < 0).any() else 0


def width_change(
    reach: Float[np.ndarray, "batch frames objects directions"], width: Float[np.ndarray, "batch"]
) -> Float[np.ndarray, "batch frames objects directions"]:
    """What is added to support functions in evenly spread directions where edges lie ``width`` px farther out."""
    change = np.broadcast_to(width[:, None, None, None], reach.shape)
    rows = np.nonzero(width < 0)[0]
    if not len(rows):
        return change
    change = change.copy()
    change[rows] = inner(reach[rows] + change[rows]) - reach[rows]
    return change


def inner(bounds: Float[np.ndarray, "*grid directions"]) -> Float[np.ndarray, "*grid directions"]:
    """Support functions of what lies within ``bounds`` in all directions, which need not be a support function itself.

    The greatest minorant h with h(a - s) + h(a + s) >= 2 cos(s) h(a), by sweeps over all scales s (Schneider, Convex
    Bodies, 1.7).
    """
    count = bounds.shape[-1]
    scales = [2**k for k in reversed(range(count.bit_length())) if 2**k < count / 4]
    flat, reach = bounds.reshape(-1, count), scales[0]
    result = np.empty(flat.shape, flat.dtype)
    for first in range(0, len(flat), BLOCK):
        part = flat[first : first + BLOCK]
        # Directions come first, with as many more at both ends as the greatest step reaches: neighbours are slices.
        ring = np.empty((count + 2 * reach, len(part)), flat.dtype)
        h, beside = ring[reach : reach + count], np.empty((count, len(part)), flat.dtype)
        h[:] = part.T
        for step in scales * SWEEPS:
            ring[reach - step : reach], ring[reach + count : reach + count + step] = h[-step:], h[:step]
            np.add(ring[reach - step :][:count], ring[reach + step :][:count], out=beside)
            beside *= 0.5 / np.cos(2 * np.pi * step / count)
            np.minimum(h, beside, out=h)
        result[first : first + BLOCK] = h.T
    return result.reshape(bounds.shape)
