"""Masks that are systematically too fat or too thin."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, OutlineView


class MaskBias(EffectKind):
    """Masks reach ``width`` pixels too far on every side."""

    name = "mask_bias"
    sentence = "the masks are systematically too fat or too thin"
    experiment = "Compare a mask with the picture by eye; a true size changes with distance, a bias does not."
    channel = "perception"
    drawn = True
    imitated = True
    parameters = (EffectParameter("width", "px", 2.0, -100.0, 100.0),)

    def outline(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        return np.broadcast_to(values[:, 0, None, None, None], view.reach.shape)
