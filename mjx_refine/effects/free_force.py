"""A force that no entry of the catalogue describes: what `unknown` means where something pushes."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Loads, Motion, Start, of_target

KNOTS = 7
"""Moments between which the force changes evenly."""


class FreeForce(EffectKind):
    """A force through the centre that is given at ``KNOTS`` moments, the same time apart, and goes straight in between.

    It has no name in the catalogue and no place in a scene file: a diagnosis compares its answer with it, and where it explains
    a clip better than an effect with fewer numbers, that effect is not what acts (a spline for a force that is not known:
    Kennedy & O'Hagan 2001 have a Gaussian process in that place).
    """

    name = "free_force"
    sentence = "something pushes {target} that no effect of the catalogue describes"
    targeted = True
    physical = True
    parameters = (
        EffectParameter("until", "s", 1.0, 1e-3, 1e4, 1.0, None),
        EffectParameter("x", "N", 1.0, -1e5, 1e5, length=KNOTS),
        EffectParameter("y", "N", 1.0, -1e5, 1e5, length=KNOTS),
        EffectParameter("z", "N", 1.0, -1e5, 1e5, length=KNOTS),
    )

    def loads(self, motion: Motion, target: int, values: np.ndarray) -> Loads | None:
        middle = motion.time + 0.5 * motion.step
        place = np.clip(middle / values[:, 0] * (KNOTS - 1), 0.0, KNOTS - 1.0)
        weights = np.clip(1.0 - np.abs(place[:, None] - np.arange(KNOTS)), 0.0, None)
        force = np.einsum("bck,bk->bc", values[:, 1:].reshape(-1, 3, KNOTS), weights)
        force = of_target(motion.batch, target, force)
        return force, np.zeros_like(force)

    def starts(self, view: FitView, target: int) -> list[Start]:
        values = np.zeros(1 + 3 * KNOTS)
        values[0] = (view.frames - 1) / view.fps
        width = np.full(len(values), WIDTH * view.mass(target))
        return [Start(values, tuple((k, 0.3 * width[k]) for k in range(1, len(values))), width, fixed=(0,))]


WIDTH = 2.0
"""Prior standard deviation of what the force gives a body [m/s^2]."""
