"""A camera that jitters."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.camera_motion import turned
from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Start


class CameraShake(EffectKind):
    """It is turned to the right and upwards by an angle of its own in every frame."""

    name = "camera_shake"
    sentence = "the camera jitters"
    experiment = "Film from a tripod."
    channel = "camera"
    parameters = (
        EffectParameter("yaw", "degree", 0.5, -45.0, 45.0, length=-1),
        EffectParameter("pitch", "degree", 0.5, -45.0, 45.0, length=-1),
    )

    def camera(self, frames: int, fps: float, values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        half = values.shape[1] // 2
        yaw, pitch = _long(values[:, :half], frames), _long(values[:, half:], frames)
        return turned(np.deg2rad(yaw), np.deg2rad(pitch)), np.zeros((len(values), frames, 3))

    def starts(self, view: FitView, target: int) -> list[Start]:
        """The jitter that the background's flow shows, summed up; it is not fitted further."""
        if not np.isfinite(view.background).any():
            return []
        with np.errstate(all="ignore"):
            moved = np.array([[_middle(one[:, k]) for k in range(2)] for one in view.background])
        # Jitter turns back at once: white noise has three times as much energy in second differences as in first ones.
        if len(moved) < 3 or (np.diff(moved, axis=0) ** 2).mean() < (moved**2).mean():
            return []
        focal = (view.image[1] / 2) / np.tan(float(view.batch.camera_fovy[0]) / 2)
        place = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, 0)])
        # The camera turns right: the picture moves left.
        angle = np.rad2deg(np.arctan(place / focal))
        values = np.concatenate([-angle[:, 0], angle[:, 1]])
        return [Start(values, fixed=tuple(range(len(values))))]


def _long(series: np.ndarray, frames: int) -> np.ndarray:
    missing = frames - series.shape[1]
    return series[:, :frames] if missing <= 0 else np.concatenate([series, np.repeat(series[:, -1:], missing, 1)], 1)


def _middle(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else 0.0
