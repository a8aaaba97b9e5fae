"""Moving air that pushes all objects one way."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Loads, Motion, Start

DRAG = {"sphere": 0.47, "cylinder": 0.8, "box": 1.05}
"""Drag coefficients of blunt bodies at Reynolds numbers of 1e4 to 1e5 (Hoerner, Fluid-Dynamic Drag, 3; a short cylinder's is 0.7
end-on and 0.8 to 1.2 across)."""


class Wind(EffectKind):
    """F = c p A |r| r, r = w - slowness v: what presses a body at rest is c p A w, and the less the more it goes with the air.

    w is the wind's direction, p its pressure on the first object at rest, c the drag coefficient of the body's shape over the
    first one's, A a quarter of the body's surface, which is its mean shadow (Cauchy's formula), and ``slowness`` one over the
    air's speed; at 0 the force is the same at all speeds. Drag is quadratic in the velocity relative to the air (White, Fluid
    Mechanics, 7.6).
    """

    name = "wind"
    sentence = "moving air pushes everything one way"
    experiment = "Film a body at rest on the floor, and one in flight: wind pushes both, a slope only what lies on it."
    physical = True
    steady = True
    parameters = (
        EffectParameter("x", "Pa", 10.0, -1e5, 1e5),
        EffectParameter("y", "Pa", 10.0, -1e5, 1e5),
        EffectParameter("slowness", "s/m", 0.15, 0.0, 1.0),
    )

    def loads(self, motion: Motion, target: int, values: np.ndarray) -> Loads | None:
        key = (self.name, id(values))
        if key not in motion.lasting:
            motion.lasting[key] = self._of_all_steps(motion.batch, values)
        direction, steady, slowness, most = motion.lasting[key]
        if slowness is None:
            return steady * direction, np.zeros_like(direction)
        against = direction - slowness * motion.velocity
        resistance = steady * rotations.length(against)[..., None]
        return np.minimum(resistance, most) * against, np.zeros_like(against)

    def _of_all_steps(
        self, batch: SceneBatch, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, Any]:
        """Directions of the wind on each body, what it presses with at rest, ``slowness`` and what may be pressed with at most;
        without slowness what is pressed along each axis, and None."""
        shadow = felt_shadow(batch)[..., None]
        pressure, along = values[:, None, :2], np.zeros((*batch.mass.shape, 3))
        if not values[:, 2].any():
            along[..., :2] = pressure
            return along, shadow, None, None
        strength = np.linalg.norm(pressure, axis=-1, keepdims=True)
        along[..., :2] = pressure / np.maximum(strength, 1e-300)
        slowness = values[:, 2, None, None]
        # One explicit step may at most stop the body.
        return along, strength * shadow, slowness, 100.0 * batch.mass[..., None] / np.maximum(slowness, 1e-9)

    def idle(self, motion: Motion, target: int, values: np.ndarray) -> float:
        return 0.0 if values[:, 2].any() else np.inf

    def still(self, view: FitView, target: int) -> Start:
        start = super().still(view, target)
        # Without pressure no speed of the air does anything.
        return dataclasses.replace(start, columns=start.columns[:2])

    def widths(self, view: FitView, target: int) -> np.ndarray:
        # A metre per second squared or two on the object that feels it most.
        push = 1.5 * float((view.batch.mass / felt_shadow(view.batch)).min())
        return np.array([push, push, self.parameters[2].width])


def felt_shadow(batch) -> np.ndarray:
    """Mean shadows times how much more wind presses each shape than the first object's [m^2], (batch, objects)."""
    more = np.array([DRAG[shape] for shape in batch.shapes]) / DRAG[batch.shapes[0]]
    return mean_shadow(batch) * more


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
