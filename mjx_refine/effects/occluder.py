"""Something unseen in front of the objects."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, OutlineView, Start

COARSE = 16
"""Directions in which what is left of outlines is told; in those between as in the one before. Of areas and their middles,
which all directions tell, it is ``hidden`` that speaks."""


def _beyond(contact: np.ndarray, normals: np.ndarray, axis: int, sign: float, side: np.ndarray) -> np.ndarray:
    """Support function of the polygon of ``contact`` points cut at sign * x[axis] > sign * side; -inf where nothing is left.

    The cut polygon's corners are the points on the right side and where edges cross the line.
    """
    along = sign * (contact[..., axis] - side)
    following, there = np.roll(contact, -1, axis=-2), np.roll(along, -1, axis=-1)
    part = along / np.where(np.abs(along - there) < 1e-9, 1e-9, along - there)
    crossing = contact + np.clip(part, 0.0, 1.0)[..., None] * (following - contact)
    most = np.full(along.shape, -np.inf)
    for points, kept in ((contact, along > 0), (crossing, (along > 0) != (there > 0))):
        reach = np.einsum("...pk,dk->...pd", points, normals)
        most = np.maximum(most, np.where(kept[..., None], reach, -np.inf).max(-2))
    return most


def _between(polygon: np.ndarray, axis: int, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Polygons cut to low < x[axis] < high: points are added where edges cross, and what lies outside is laid on the border,
    where it encloses nothing."""
    following = np.roll(polygon, -1, axis=-2)
    along = following - polygon
    length = np.where(np.abs(along[..., axis]) < 1e-9, 1e-9, along[..., axis])
    crossings = [np.clip((side - polygon[..., axis]) / length, 0.0, 1.0) for side in (low, high)]
    parts = np.stack([np.zeros_like(crossings[0]), np.minimum(*crossings), np.maximum(*crossings)], -1)
    points = polygon[..., None, :] + parts[..., None] * along[..., None, :]
    points[..., axis] = np.clip(points[..., axis], low[..., None], high[..., None])
    return points.reshape(*polygon.shape[:-2], -1, 2)


class Occluder(EffectKind):
    """Inside an upright rectangle of the picture nothing of the objects is seen."""

    name = "occluder"
    sentence = "something that is not in the scene hides part of the view"
    experiment = "Look at the place in the picture, or film from another side."
    channel = "perception"
    drawn = True
    parameters = tuple(
        EffectParameter(side, "px", 8.0, -1e4, 1e5, 0.0, None) for side in ("left", "top", "right", "bottom")
    )

    def directions(self, values: np.ndarray) -> int:
        return 64

    def outline(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        left, top, right, bottom = (values[:, k, None, None, None] for k in range(4))
        step = max(len(view.normals) // COARSE, 1)
        contact, normals, reach = view.contact[..., ::step, :], view.normals[::step], view.reach[..., ::step]
        most = np.full(reach.shape, -np.inf)
        # What is seen is the outline's part to the left, the right, above and below of the rectangle: four convex pieces.
        for axis, sign, side in ((0, -1.0, left), (0, 1.0, right), (1, -1.0, top), (1, 1.0, bottom)):
            most = np.maximum(most, _beyond(contact, normals, axis, sign, side))
        change = np.where(np.isfinite(most), np.minimum(most - reach, 0.0), np.nan)
        return np.repeat(change, step, -1)[..., : len(view.normals)]

    def hidden(self, outline: np.ndarray, values: np.ndarray) -> np.ndarray | None:
        left, top, right, bottom = (values[:, k, None, None, None] for k in range(4))
        return _between(_between(outline, 0, left, right), 1, top, bottom)

    def starts(self, view: FitView, target: int) -> list[Start]:
        return [Start(np.array(r), width=np.full(4, 6.0), places=20 * len(view.hidden)) for r in view.hidden]
