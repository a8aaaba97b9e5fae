"""What flow has in common: the motion of a whole picture, or of a whole surface, as against what it invents in places.

A camera moves all of a background together, and a body that is rigid moves the flow on it by nearly an affine function of the
place. What is measured beside a moving outline, in shadows, and where nothing has texture, is neither.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.seen.measure import Measured

FEW = 8
"""Places below which no common motion is told from noise."""


def similar(flow: Float[np.ndarray, "places 2"], places: Float[np.ndarray, "places 2"]) -> float:
    """Sum of squares of the shift, turn and stretch nearest to a flow; what as many numbers of noise have of it is taken off."""
    x, y, one, none = _axes(places)
    return _shared(flow, [(one, none), (none, one), (-y, x), (x, y)])


def of_background(
    measured: Measured, background: Float[np.ndarray, "intervals places 2"]
) -> Float[np.ndarray, "intervals"]:
    """``similar`` of residuals of the background's flow, where it was measured."""
    seen = np.isfinite(measured.background).all(-1)
    told = zip(background, np.atleast_2d(seen), strict=True)
    return np.array([similar(row[ok], measured.places[ok]) for row, ok in told])


def affine(flow: Float[np.ndarray, "places 2"], places: Float[np.ndarray, "places 2"]) -> float:
    """Ditto of the affine function of the place nearest to a flow."""
    x, y, one, none = _axes(places)
    return _shared(flow, [(a, none) for a in (one, x, y)] + [(none, a) for a in (one, x, y)])


def _axes(places: np.ndarray) -> tuple[np.ndarray, ...]:
    x, y = ((places - places.mean(0)) / max(np.ptp(places, axis=0).max(), 1e-9)).T if len(places) else np.zeros((2, 0))
    return x, y, np.ones(len(x)), np.zeros(len(x))


def _shared(flow: np.ndarray, columns: list[tuple[np.ndarray, np.ndarray]]) -> float:
    if len(flow) < FEW:
        return 0.0
    design, wanted = np.stack([np.concatenate(column) for column in columns], 1), flow.T.ravel()
    left = wanted - design @ np.linalg.lstsq(design, wanted, rcond=None)[0]
    count = len(wanted) / (len(wanted) - len(columns))
    return max(float(wanted @ wanted - left @ left * count), 0.0)
