"""An outline that is not its primitive's."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, OutlineView
from mjx_refine.scene import Shape

ORDERS = (2, 3, 4)
COUNT = sum(2 * order + 1 for order in ORDERS)


class OutlineShape(EffectKind):
    """The body reaches farther than its primitive by a sum of polynomials of its normal n in its own frame; edges of boxes and
    cylinders are worn to a radius, and these grow thinner along their z axis.

    The support function of the convex body becomes h(n) + sum of a_k P_k(n), P_k the monomials of degree 2, 3 and 4 that
    span the harmonics of these degrees (Schneider, Convex Bodies, 3.3). With taper s the sides are (1 - s) of the
    primitive's at its upper end and (1 + s) at its lower one; a body that a ball of radius r rolls around inside of (the opening
    by the ball, where no side is shorter than 2 r) reaches r less far for every face, and r farther for itself. Motion and
    contacts stay the primitive's.
    """

    name = "shape"
    sentence = "{target}'s outline is not its {shape}'s"
    experiment = "Turn {target} before the camera and look at it from several sides."
    targeted = True
    channel = "shape"
    drawn = True
    parameters = (
        EffectParameter("bulge", "m", 0.02, -1e2, 1e2, length=COUNT),
        EffectParameter("rounding", "m", 0.02, 0.0, 1e2),
        EffectParameter("taper", "1", 0.15, -0.9, 0.9),
    )

    def directions(self, values: np.ndarray) -> int:
        return 64

    def outline(self, view: OutlineView, target: int, values: np.ndarray) -> np.ndarray | None:
        added = np.zeros(view.reach.shape)
        normal = view.facing[:, :, target]
        extra = np.einsum("kbtd,bk->btd", polynomials(normal), values[:, :COUNT])
        rounding, taper = values[:, None, None, COUNT], values[:, None, None, COUNT + 1]
        extra = extra + worn(view.shapes[target], view.size[:, target], normal, rounding, taper)
        added[:, :, target] = extra * view.scale[:, :, target]
        return added

    def widths(self, view: FitView, target: int) -> np.ndarray:
        orders = np.repeat(ORDERS, [2 * order + 1 for order in ORDERS])
        size = view.batch.size[0, target]
        return np.concatenate([0.3 * float(size.max()) / orders, [0.3 * float(size[size > 0].min()), 0.15]])


def worn(
    shape: Shape,
    size: Float[np.ndarray, "batch 3"],
    normal: Float[np.ndarray, "batch frames directions 3"],
    rounding: Float[np.ndarray, "batch 1 1"],
    taper: Float[np.ndarray, "batch 1 1"],
) -> Float[np.ndarray, "batch frames directions"]:
    """What tapered sides and round edges add to a primitive's support function at unit normals [m]."""
    if shape == "sphere":
        return np.zeros(normal.shape[:-1])
    x, y, z = np.moveaxis(normal, -1, 0)
    if shape == "box":
        a, b, half = (size[:, None, None, k] for k in range(3))
        across, faces = a * np.abs(x) + b * np.abs(y), np.abs(x) + np.abs(y)
    else:
        radius, half = (size[:, None, None, k] for k in range(2))
        faces = np.hypot(x, y)
        across = radius * faces
    ends = np.maximum(half * z + (1 - taper) * across, -half * z + (1 + taper) * across)
    return ends - half * np.abs(z) - across + rounding * (1 - faces - np.abs(z))


def polynomials(normal: np.ndarray) -> np.ndarray:
    """Real harmonics of degrees 2, 3 and 4 at unit vectors (..., 3), up to factors of order one; (COUNT, ...)."""
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
    return np.stack(second + third + fourth)
