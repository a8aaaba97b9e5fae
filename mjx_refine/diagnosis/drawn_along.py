"""Measured flow is drawn along by outlines.

A surface that moves across its own outline, as that of a ball that rolls or of a body that tumbles, shows through texture alone, while the outline is an edge against what
lies behind: what smooths flow, as every method does, takes the surface's motion for more like the outline's than it is.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.measure import Measured, Parts

SEEN, EACH = 0.8, ((0.15, 0.1), (0.15, 0.1))
"""Part of the surface's motion against its outline that measured flow shows."""


def against(
    flow: Float[np.ndarray, "batch intervals objects points 2"], moments: Float[np.ndarray, "batch frames objects 3"]
) -> Float[np.ndarray, "batch intervals objects points 2"]:
    """Flow of surfaces against their silhouettes' centroids [px/frame]; where those are not seen, against its own mean."""
    centroids = np.diff(moments[..., :2], axis=1)
    return flow - np.where(np.isfinite(centroids), centroids, flow.mean(-2))[..., None, :]


def drawn_along(
    flow: Float[np.ndarray, "batch intervals objects points 2"], moments: Float[np.ndarray, "batch frames objects 3"]
) -> Float[np.ndarray, "batch intervals objects points 2"]:
    """What is measured of a flow [px/frame]."""
    return flow - (1 - SEEN) * against(flow, moments)


def uncertain(measured: Measured, told: Parts) -> Parts:
    """What measured flow may err by, one standard deviation a row: the motion of each object as a whole and within, from beginning to end, by more at one of them."""
    objects = told.flow.shape[-3]
    moved = against(told.flow, told.moments)[0]
    moved = np.where(np.isfinite(measured.flow), moved, 0.0) / SEEN
    whole = np.broadcast_to(moved.mean(-2, keepdims=True), moved.shape)
    time = np.linspace(-1.0, 1.0, len(moved))[:, None, None, None]
    rows = [
        part * width * course
        for part, widths in zip((whole, moved - whole), EACH, strict=True)
        for width, course in zip(widths, (np.ones_like(time), time), strict=True)
    ]
    result = Parts(*(np.zeros((len(rows) * objects, *part.shape)) for part in measured.parts))
    for k, row in enumerate(rows):
        for n in range(objects):
            result.flow[k * objects + n, :, n] = np.nan_to_num(row[:, n])
    return result
