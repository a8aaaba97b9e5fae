"""Resistance of the air."""

from __future__ import annotations

import numpy as np

from mjx_refine import rotations
from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Loads, Motion, of_target


class Drag(EffectKind):
    """F = -(linear + quadratic |v|) v."""

    name = "drag"
    sentence = "{target} is slowed by the air"
    experiment = "Film {target} at twice the speed, and once nearly still: drag grows with speed, wind does not."
    targeted = True
    physical = True
    steady = True
    parameters = (
        EffectParameter("linear", "N s/m", 0.3, 0.0, 1e4),
        EffectParameter("quadratic", "N s^2/m^2", 0.1, 0.0, 1e4),
    )

    def loads(self, motion: Motion, target: int, values: np.ndarray) -> Loads | None:
        v = motion.velocity[:, target]
        speed = rotations.length(v)
        # One explicit step may at most stop the body.
        resistance = np.minimum(values[:, 0] + values[:, 1] * speed, 100.0 * motion.batch.mass[:, target])
        force = of_target(motion.batch, target, -resistance[:, None] * v)
        return force, np.zeros_like(force)

    def widths(self, view: FitView, target: int) -> np.ndarray:
        return super().widths(view, target) * view.mass(target)
