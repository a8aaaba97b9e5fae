"""Lift of a spinning body."""

from __future__ import annotations

import numpy as np

from mjx_refine import rotations
from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Loads, Motion, of_target


class Magnus(EffectKind):
    """F = coefficient (spin x velocity)."""

    name = "magnus"
    sentence = "{target}'s spin bends its path through the air"
    experiment = "Film {target} with the opposite spin: a Magnus force bends the path the other way."
    targeted = True
    physical = True
    imitated = True
    steady = True
    parameters = (EffectParameter("coefficient", "kg", 0.05, -1e3, 1e3),)

    def loads(self, motion: Motion, target: int, values: np.ndarray) -> Loads | None:
        lift = values[:, :1] * rotations.cross(motion.spin_of(target), motion.velocity[:, target])
        most = 100.0 * motion.batch.mass[:, target, None]
        force = of_target(motion.batch, target, np.clip(lift, -most, most))
        return force, np.zeros_like(force)

    def widths(self, view: FitView, target: int) -> np.ndarray:
        return super().widths(view, target) * view.mass(target)
