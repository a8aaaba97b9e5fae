"""A camera that pans or travels steadily."""

from __future__ import annotations

import numpy as np

from mjx_refine import rotations
from mjx_refine.effects.kind import EffectKind, EffectParameter


class CameraMotion(EffectKind):
    """It turns to the right by ``pan`` and upwards by ``tilt``, and travels by (x, y, z); frame 0 is the scene's camera."""

    name = "camera_motion"
    sentence = "the camera pans or travels"
    experiment = "Film from a tripod."
    channel = "camera"
    parameters = (
        EffectParameter("pan", "degree/s", 4.0, -720.0, 720.0),
        EffectParameter("tilt", "degree/s", 4.0, -720.0, 720.0),
        EffectParameter("x", "m/s", 0.2, -1e3, 1e3),
        EffectParameter("y", "m/s", 0.2, -1e3, 1e3),
        EffectParameter("z", "m/s", 0.2, -1e3, 1e3),
    )

    def camera(self, frames: int, fps: float, values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        time = np.arange(frames) / fps
        angle = np.deg2rad(values[:, :2, None] * time)
        return turned(angle[:, 0], angle[:, 1]), values[:, None, 2:] * time[:, None]


def turned(right: np.ndarray, up: np.ndarray, roll: np.ndarray | None = None) -> np.ndarray:
    """Rotations of a camera in its own axes (right, up, back) by angles [rad], (..., 3, 3)."""
    vector = np.stack([up, -right, np.zeros_like(up) if roll is None else roll], -1)
    return rotations.matrix(rotations.exponential(vector))
