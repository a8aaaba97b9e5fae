"""A sensor whose rows are exposed one after another."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, OutlineView


class RollingShutter(EffectKind):
    """A row at height y of H shows time t + readout (y / H - 1/2)."""

    name = "rolling_shutter"
    sentence = "the picture's rows are exposed one after another"
    experiment = "Film with the camera turned by 90 degrees: the skew turns with it."
    channel = "timing"
    drawn = True
    imitated = True
    parameters = (EffectParameter("readout", "s", 0.012, -0.2, 0.2),)

    def outline(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        late = values[:, 0, None, None, None] * view.fps * (view.contact[..., 1] / view.image[1] - 0.5)
        return view.rate * late
