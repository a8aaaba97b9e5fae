"""A lens that bends straight lines."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, OutlineView


class LensDistortion(EffectKind):
    """Radial: distorted = undistorted (1 + k1 r^2), r from the middle in focal lengths (Brown 1966; OpenCV's k1)."""

    name = "lens_distortion"
    sentence = "the lens bends straight lines"
    experiment = "Film a chessboard that fills the view."
    channel = "camera"
    drawn = True
    imitated = True
    steady = True
    parameters = (EffectParameter("k1", "1", 0.15, -1.0, 3.0),)

    def warp(self, points: np.ndarray, focal: np.ndarray, image: tuple[int, int], values: np.ndarray):
        ones = (1,) * (points.ndim - 1)
        middle = np.array([image[0] / 2, image[1] / 2])
        offset = points - middle
        square = (offset**2).sum(-1, keepdims=True) / focal.reshape(-1, *ones) ** 2
        return values[:, 0].reshape(-1, *ones) * np.minimum(square, 4.0) * offset

    def moved(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        return self.warp(view.contact, view.focal, view.image, values)
