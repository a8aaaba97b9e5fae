"""An outline that is not its primitive's."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, OutlineView

ORDERS = (2, 3, 4)
COUNT = sum(2 * order + 1 for order in ORDERS)


class OutlineShape(EffectKind):
    """The body reaches farther than its primitive by a sum of polynomials of its normal n in its own frame.

    The support function of the convex body becomes h(n) + sum of a_k P_k(n), P_k the monomials of degree 2, 3 and 4 that
    span the harmonics of these degrees (Schneider, Convex Bodies, 3.3). Motion and contacts stay the primitive's.
    """

    name = "shape"
    sentence = "{target}'s outline is not its {shape}'s"
    experiment = "Turn {target} before the camera and look at it from several sides."
    targeted = True
    channel = "shape"
    drawn = True
    parameters = (EffectParameter("bulge", "m", 0.02, -1e2, 1e2, length=COUNT),)

    def outline(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        added = np.zeros(view.reach.shape)
        extra = (polynomials(view.facing[:, :, target]) * values[:, None, None]).sum(-1)
        added[:, :, target] = extra * view.scale[:, :, target]
        return added

    def widths(self, view: FitView, target: int) -> np.ndarray:
        orders = np.repeat(ORDERS, [2 * order + 1 for order in ORDERS])
        return 0.15 * float(view.batch.size[0, target].max()) * 2.0 / orders


def polynomials(normal: np.ndarray) -> np.ndarray:
    """Real harmonics of degrees 2, 3 and 4 at unit vectors, up to factors of order one; (..., COUNT)."""
    x, y, z = np.moveaxis(normal, -1, 0)
    a, b, c = x * x, y * y, z * z
    second = [x * y, y * z, z * x, a - b, 2 * c - a - b]
    third = [
        x * y * z * 2,
        z * (a - b),
        x * (5 * c - 1),
        y * (5 * c - 1),
        z * (5 * c - 3) / 1.5,
        x * (a - 3 * b),
        y * (3 * a - b),
    ]
    fourth = [
        x * y * (a - b) * 2,
        x * z * (a - 3 * b),
        y * z * (3 * a - b),
        x * y * (7 * c - 1),
        (a - b) * (7 * c - 1) / 2,
        x * z * (7 * c - 3),
        y * z * (7 * c - 3),
        (35 * c * c - 30 * c + 3) / 8,
        (a * a - 6 * a * b + b * b) / 1.5,
    ]
    return np.stack(second + third + fourth, -1)
