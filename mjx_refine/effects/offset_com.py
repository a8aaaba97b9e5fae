"""A centre of mass that is not at the centre."""

from __future__ import annotations

import numpy as np

from mjx_refine.batch import SceneBatch
from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, of_target


class OffsetCom(EffectKind):
    """The centre of mass lies at (x, y, z) in the body's frame."""

    name = "offset_com"
    sentence = "{target}'s centre of mass is not at its centre"
    experiment = "Throw {target} with much spin: its centre then circles about the centre of mass."
    targeted = True
    channel = "rotation"
    physical = True
    imitated = True
    steady = True
    parameters = tuple(EffectParameter(axis, "m", 0.05, -1e2, 1e2) for axis in "xyz")

    def centre_of_mass(self, batch: SceneBatch, target: int, values: np.ndarray) -> np.ndarray | None:
        return of_target(batch, target, values)

    def widths(self, view: FitView, target: int) -> np.ndarray:
        return np.full(3, 0.25 * float(view.batch.size[0, target].max()))
