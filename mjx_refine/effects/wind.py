"""Moving air that pushes all objects one way."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Loads, Motion


class Wind(EffectKind):
    """F = pressure times a quarter of the body's surface, which is its mean shadow (Cauchy's formula)."""

    name = "wind"
    sentence = "moving air pushes everything one way"
    experiment = "Film a body at rest on the floor, and one in flight: wind pushes both, a slope only what lies on it."
    physical = True
    parameters = (EffectParameter("x", "Pa", 10.0, -1e5, 1e5), EffectParameter("y", "Pa", 10.0, -1e5, 1e5))

    def loads(self, motion: Motion, target: int, values: np.ndarray) -> Loads | None:
        force = np.zeros_like(motion.position)
        force[..., :2] = values[:, None] * mean_shadow(motion.batch)[..., None]
        return force, np.zeros_like(force)

    def idle(self, motion: Motion, target: int, values: np.ndarray) -> float:
        return np.inf

    def widths(self, view: FitView, target: int) -> np.ndarray:
        # A metre per second squared or two on the object that feels it most.
        return np.full(2, 1.5 * float((view.batch.mass / mean_shadow(view.batch)).min()))


def mean_shadow(batch) -> np.ndarray:
    """A quarter of each body's surface [m^2], (batch, objects)."""
    columns = []
    for i, shape in enumerate(batch.shapes):
        x, y, z = np.moveaxis(batch.size[:, i], -1, 0)
        if shape == "sphere":
            columns.append(np.pi * x**2)
        elif shape == "cylinder":
            columns.append(np.pi * x * (x + 2 * y) / 2)
        else:
            columns.append(2 * (x * y + y * z + z * x))
    return np.stack(columns, 1)
