"""A tilted floor."""

from __future__ import annotations

import numpy as np

from mjx_refine import rotations
from mjx_refine.effects.kind import EffectKind, EffectParameter


class Slope(EffectKind):
    """The plane z = 0 turned about the world's x axis, then about its y axis, through the origin; gravity stays."""

    name = "slope"
    sentence = "the floor is tilted"
    experiment = (
        "Put a ball at rest on the floor: on a slope it starts to roll. A body in flight does not feel a slope."
    )
    physical = True
    imitated = True
    steady = True
    parameters = (EffectParameter("x", "degree", 4.0, -60.0, 60.0), EffectParameter("y", "degree", 4.0, -60.0, 60.0))

    def floor(self, values: np.ndarray) -> np.ndarray | None:
        angle = np.deg2rad(values)
        zero = np.zeros(len(values))
        about_x = rotations.matrix(rotations.exponential(np.stack([angle[:, 0], zero, zero], -1)))
        about_y = rotations.matrix(rotations.exponential(np.stack([zero, angle[:, 1], zero], -1)))
        return about_y @ about_x
