"""A sensor whose rows are exposed one after another."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, OutlineView

FASTEST = 0.5
"""Speed across the rows, as a part of the shutter's own, up to which it is followed."""


class RollingShutter(EffectKind):
    """A row at height y of H shows time t + readout (y / H - 1/2)."""

    name = "rolling_shutter"
    sentence = "the picture's rows are exposed one after another"
    experiment = "Film with the camera turned by 90 degrees: the skew turns with it."
    channel = "timing"
    drawn = True
    imitated = True
    steady = True
    parameters = (EffectParameter("readout", "s", 0.012, -0.2, 0.2),)

    def moved(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        # Along the outline points go as its middle does; one that goes down the rows meets its own the later.
        middle = 2.0 * (view.rate[..., None] * view.normals).mean(-2, keepdims=True)
        along = middle - (middle * view.normals).sum(-1, keepdims=True) * view.normals
        velocity = view.rate[..., None] * view.normals + along
        a_row = values[:, 0, None, None, None] * view.fps / view.image[1]
        ahead = np.clip(a_row * velocity[..., 1], -FASTEST, FASTEST)
        late = a_row * (view.contact[..., 1] - 0.5 * view.image[1]) / (1.0 - ahead)
        return velocity * late[..., None]
