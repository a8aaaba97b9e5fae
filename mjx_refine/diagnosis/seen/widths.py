"""By how much masks may be too wide."""

from __future__ import annotations

import numpy as np

from mjx_refine.diagnosis.seen.measure import Measured, Parts

BIAS = (0.5, 0.15)
"""Standard deviations of what masks are too wide by, by object: of outlines, whose farthest pixel noise moves outward, and
of equivalent radii [px]."""

HALF = (0.42, 0.71)
"""What that moves the centroid away from a line that cuts a mask, and adds to the equivalent radius of what is left, as parts of
what it adds to the whole one's: of half a disc."""


def too_wide(measured: Measured) -> Parts:
    """Masks that are too wide by one standard deviation, a row an object [px]."""
    parts = Parts(*(np.zeros((measured.reach.shape[1], *part.shape)) for part in measured.parts))
    for n in range(len(parts.reach)):
        parts.reach[n, :, n] = np.where(np.isfinite(measured.reach[:, n]), BIAS[0], 0.0)
        parts.moments[n, :, n, 2] = np.where(np.isfinite(measured.moments[:, n, 2]), BIAS[1], 0.0)
        if measured.planes is not None:
            normal = np.nan_to_num(measured.planes[:, n, :2])
            parts.moments[n, :, n, :2] = -HALF[0] * BIAS[1] * normal
            parts.moments[n, :, n, 2] *= np.where(normal.any(-1), HALF[1], 1.0)
    return parts
