"""A tilted floor."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter


class Slope(EffectKind):
    """The plane z = 0 turned about the world's x axis, then about its y axis, through the origin; gravity stays."""

    name = "slope"
    sentence = "the floor is tilted"
    experiment = (
        "Put a ball at rest on the floor: on a slope it starts to roll. A body in flight does not feel a slope."
    )
    physical = True
    parameters = (EffectParameter("x", "degree", 4.0, -60.0, 60.0), EffectParameter("y", "degree", 4.0, -60.0, 60.0))

    def floor(self, values: np.ndarray) -> np.ndarray | None:
        a, b = np.deg2rad(values[:, 0]), np.deg2rad(values[:, 1])
        zero, one = np.zeros_like(a), np.ones_like(a)
        about_x = np.array([[one, zero, zero], [zero, np.cos(a), -np.sin(a)], [zero, np.sin(a), np.cos(a)]])
        about_y = np.array([[np.cos(b), zero, np.sin(b)], [zero, one, zero], [-np.sin(b), zero, np.cos(b)]])
        return np.moveaxis(about_y, -1, 0) @ np.moveaxis(about_x, -1, 0)
