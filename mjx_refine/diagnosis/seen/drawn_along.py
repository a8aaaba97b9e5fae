"""Measured flow is drawn along by outlines.

A surface that moves across its own outline, as that of a ball that rolls or of a body that tumbles, shows through its texture
alone; the outline is an edge against what lies behind. Whatever smooths flow takes the surface's motion for more like the
outline's than it is. Of ten objects in six withheld clips without effect (seed 18, OpenCV's DIS) the part that shows of it was
0.63 to 0.95, 0.76 in the median. Held to the whole, base models of five of six clips slipped on floors of hardly any friction
instead, and one of these explained a wind.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.seen.measure import Measured, Parts
from mjx_refine.diagnosis.seen.widths import too_wide

SHOWS = 0.8
"""Part that measured flow shows of a surface's motion against its outline."""

WHOLE, WITHIN = (0.15, 0.1), (0.15, 0.1)
"""Standard deviations of that part, for an object's mean flow and for what its points differ from it: all the time, and how
much more at the end than in the middle."""


def against(
    flow: Float[np.ndarray, "batch intervals objects points 2"], moments: Float[np.ndarray, "batch frames objects 3"]
) -> Float[np.ndarray, "batch intervals objects points 2"]:
    """Flow of surfaces against their silhouettes' centroids, or against its own mean where these are not seen [px/frame]."""
    centroids = np.diff(moments[..., :2], axis=1)
    return flow - np.where(np.isfinite(centroids), centroids, flow.mean(-2))[..., None, :]


def drawn_along(
    flow: Float[np.ndarray, "batch intervals objects points 2"], moments: Float[np.ndarray, "batch frames objects 3"]
) -> Float[np.ndarray, "batch intervals objects points 2"]:
    """What is measured of a flow.

    Args:
      flow: of the surfaces [px/frame].
      moments: centroids and equivalent radii of the silhouettes [px].
    """
    return flow - (1 - SHOWS) * against(flow, moments)


def uncertain(
    measured: Measured,
    flow: Float[np.ndarray, "1 intervals objects points 2"],
    moments: Float[np.ndarray, "1 frames objects 3"],
) -> Parts:
    """What measured flow may err by since nobody knows how far outlines draw it, one standard deviation a row [px].

    Args:
      measured: what was seen; where nothing was, nothing errs.
      flow: that is predicted, drawn along [px/frame].
      moments: predicted centroids and equivalent radii of whole silhouettes [px].
    """
    moved = np.where(np.isfinite(measured.flow), against(flow, moments)[0], 0.0) / SHOWS
    mean = np.broadcast_to(moved.mean(-2, keepdims=True), moved.shape)
    later = np.linspace(-1.0, 1.0, len(moved))[:, None, None, None]
    courses = (np.ones_like(later), later)
    rows = [
        width * part * course
        for part, widths in ((mean, WHOLE), (moved - mean, WITHIN))
        for width, course in zip(widths, courses, strict=True)
    ]
    each = np.nan_to_num(np.stack(rows))
    objects = np.arange(moved.shape[1])
    off = np.zeros((len(rows), len(objects), *moved.shape))
    off[:, objects, :, objects] = np.moveaxis(each, 2, 0)
    blank = (np.zeros((len(rows) * len(objects), *part.shape)) for part in measured.parts)
    return Parts(*blank)._replace(flow=off.reshape(-1, *moved.shape))


def always_off(
    measured: Measured,
    flow: Float[np.ndarray, "1 intervals objects points 2"],
    moments: Float[np.ndarray, "1 frames objects 3"],
) -> Parts:
    """What measurements may err by whatever contacts do, one standard deviation a row [px]; the rest as in ``uncertain``."""
    wide = too_wide(measured)
    return wide.beside(uncertain(measured, flow, moments)) if measured.drawn else wide
