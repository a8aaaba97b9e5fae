"""A camera that is not held level."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.camera_motion import turned
from mjx_refine.effects.kind import EffectKind, EffectParameter


class CameraRoll(EffectKind):
    """It is turned about its optical axis, counter-clockwise as seen from behind: the picture turns clockwise."""

    name = "camera_roll"
    sentence = "the camera is rolled about its optical axis"
    experiment = "Film a plumb line: it shows the roll; a ball at rest that stays so says that the floor is level."
    channel = "camera"
    imitated = True
    steady = True
    parameters = (EffectParameter("angle", "degree", 4.0, -180.0, 180.0),)

    def camera(self, frames: int, fps: float, values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        angle = np.deg2rad(np.repeat(values[:, :1], frames, 1))
        zero = np.zeros_like(angle)
        return turned(zero, zero, angle), np.zeros((*angle.shape, 3))
