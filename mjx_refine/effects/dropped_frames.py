"""Frames that are missing or doubled."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Start


class DroppedFrames(EffectKind):
    """From ``frame`` on the clip is ``count`` frames ahead; where ``count`` is negative, frame - 1 is shown again so often."""

    name = "dropped_frames"
    sentence = "frames are missing or doubled at some moment"
    experiment = "Record again and compare the frames' time stamps: a push would move one object alone, this moves all."
    channel = "timing"
    parameters = (
        EffectParameter("frame", "frame", 1.0, 1.0, 1e6, 1.0, None, whole=True),
        EffectParameter("count", "frames", 2.0, -1e3, 1e3, 0.0, None, whole=True),
    )

    def frame_times(self, frames: int, values: np.ndarray) -> np.ndarray | None:
        index = np.arange(frames)[None]
        first, count = np.round(values[:, :1]), np.round(values[:, 1:2])
        shifted = np.where(count >= 0, index + count, np.maximum(index + count, first - 1))
        return np.where(index >= first, shifted, index).astype(int)

    def starts(self, view: FitView, target: int) -> list[Start]:
        found = [np.array([f, c], float) for f in range(1, view.frames) for c in (1, 2, 3, 4, 5, -1, -2, -3, -4, -5)]
        return [Start(v, fixed=(0, 1), places=len(found)) for v in found]

    def window(self, view: FitView, target: int, values: np.ndarray) -> tuple[int, int] | None:
        first = int(np.clip(values[0], 1, view.frames - 1))
        doubled = int(max(-values[1], 0))
        return first - 1, min(first + doubled, view.frames - 1)

    def struck(self, view: FitView, values: np.ndarray) -> int:
        return int(np.linalg.norm(view.velocity, axis=-1).mean(0).argmax())
