"""Something unseen in front of the objects."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, OutlineView, Start

RINGS = np.linspace(0.0, 1.0, 9)


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

    def outline(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        left, top, right, bottom = (values[:, k, None, None, None] for k in range(4))
        centre = view.contact.mean(-2, keepdims=True)
        most = np.full(view.reach.shape, -np.inf)
        for ring in RINGS:
            points = centre + ring * (view.contact - centre)
            x, y = points[..., 0], points[..., 1]
            hidden = (x > left) & (x < right) & (y > top) & (y < bottom)
            along = (points[..., :, None, :] * view.normals).sum(-1)
            most = np.maximum(most, np.where(hidden[..., None], -np.inf, along).max(-2))
        # An outline that the rectangle leaves alone keeps its reach exactly; a hidden one has none.
        short = most - view.reach
        touched = short < -1.5
        return np.where(np.isfinite(short), np.where(touched, short, 0.0), np.nan)

    def starts(self, view: FitView, target: int) -> list[Start]:
        return [Start(np.array(r), width=np.full(4, 6.0), places=20 * len(view.hidden)) for r in view.hidden]
