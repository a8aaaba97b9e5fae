"""The direction in which two convex bodies overlap least.

The overlap along a unit direction n, from the first body to the second, is ``f(n) = h1(n) + h2(-n) - d·n``: the
bodies' support functions and the way between their centres. Its minimum over the sphere is the penetration depth, what
C MuJoCo's expanding-polytope search finds (Ong & Gilbert 1997). For cylinders and boxes the minima lie at few
directions that are known, on a few great circles, or (two rims) inside a patch; all are tried and the least wins.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Overlap = Callable[[Float[Array, "3"]], Float[Array, ""]]

_SAMPLES = 36
_NEWTON = 5


def unit(vector: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Unit vectors; where there is no direction, x."""
    square = (vector * vector).sum(-1, keepdims=True)
    small = square < 1e-16
    return jnp.where(small, jnp.array([1.0, 0.0, 0.0]), vector / jnp.sqrt(jnp.where(small, 1.0, square)))


def towards(directions: Float[Array, "... 3"], d: Float[Array, "3"]) -> Float[Array, "... 3"]:
    """The directions turned to the side of ``d``, where the overlap of symmetric bodies is the smaller one."""
    return jnp.where((directions @ d < 0)[..., None], -directions, directions)


def least_on_circle(
    overlap: Overlap, pole: Float[Array, "3"], axis: Float[Array, "3"], radius: Float[Array, ""], linear: Callable
) -> Float[Array, "3"]:
    """The direction of least overlap on the great circle around ``pole``, where it is smooth.

    Args:
      overlap: f.
      pole: unit normal of the circle.
      axis: unit axis of the cylinder whose rim touches; f is ``radius * |n x axis| + linear(n)·n + constant`` there.
      radius: of that cylinder [m].
      linear: the rest of f's gradient at n, constant near n.
    """
    u = unit(jnp.cross(axis, pole))
    w = jnp.cross(pole, u)
    spacing = 2 * np.pi / _SAMPLES
    angles = jnp.asarray((np.arange(_SAMPLES) + 0.5) * spacing, u.dtype)
    ring = jnp.cos(angles)[:, None] * u + jnp.sin(angles)[:, None] * w
    start = angles[jnp.argmin(jax.vmap(overlap)(ring))]
    slope = linear(jnp.cos(start) * u + jnp.sin(start) * w)
    a, b = slope @ u, slope @ w
    q = jnp.square(w @ axis)
    angle = start
    for _ in range(_NEWTON):
        c, s = jnp.cos(angle), jnp.sin(angle)
        rho = jnp.sqrt(jnp.maximum(1 - q * s * s, 1e-8))
        first = -radius * q * s * c / rho - a * s + b * c
        second = -radius * q * ((c * c - s * s) / rho + q * s * s * c * c / rho**3) - a * c - b * s
        step = jnp.where(second > 1e-6, -first / jnp.where(second > 1e-6, second, 1.0), -jnp.sign(first) * spacing / 8)
        angle = jnp.clip(angle + step, start - spacing, start + spacing)
    return jnp.cos(angle) * u + jnp.sin(angle) * w


def _fibonacci(count: int) -> np.ndarray:
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], -1)


def least_smooth(overlap: Overlap, d: Float[Array, "3"], axis: Float[Array, "3"], reach) -> Float[Array, "3"]:
    """A local minimum of the overlap of two cylinders where both touch with a rim.

    Args:
      overlap: f.
      d: from the first centre to the second, in the first cylinder's frame [m].
      axis: the second cylinder's.
      reach: radius and half height of the first and of the second cylinder [m].
    """
    (r1, h1), (r2, h2) = reach
    up = jnp.array([0.0, 0.0, 1.0])
    sphere = towards(jnp.asarray(_fibonacci(160), d.dtype), d)
    n = sphere[jnp.argmin(jax.vmap(overlap)(sphere))]
    eye = jnp.eye(3)
    for _ in range(8):
        gradient, hessian = -d, jnp.zeros((3, 3))
        for a, r, h in ((up, r1, h1), (axis, r2, h2)):
            along = n @ a
            across = n - along * a
            rho = jnp.sqrt(jnp.maximum(across @ across, 1e-8))
            gradient = gradient + r * across / rho + h * jnp.sign(along) * a
            hessian = hessian + r / rho * (eye - jnp.outer(a, a) - jnp.outer(across, across) / rho**2)
        # On the sphere: f extends homogeneously, so its gradient along n is f itself.
        value = gradient @ n
        first = unit(jnp.cross(n, jnp.where(jnp.abs(n[0]) < 0.7, eye[0], eye[1])))
        basis = jnp.stack([first, jnp.cross(n, first)])
        g = basis @ gradient
        b = basis @ hessian @ basis.T - value * jnp.eye(2)
        mean, spread = 0.5 * (b[0, 0] + b[1, 1]), jnp.sqrt(0.25 * (b[0, 0] - b[1, 1]) ** 2 + b[0, 1] ** 2 + 1e-20)
        b = b + jnp.maximum(0.0, 0.02 * (r1 + r2) - (mean - spread)) * jnp.eye(2)
        determinant = b[0, 0] * b[1, 1] - b[0, 1] ** 2
        step = -jnp.stack([b[1, 1] * g[0] - b[0, 1] * g[1], b[0, 0] * g[1] - b[0, 1] * g[0]]) / determinant
        step = step * jnp.minimum(1.0, 0.2 / jnp.sqrt(step @ step + 1e-18))
        n = unit(n + step @ basis)
    return n


def closest_on_lines(p: Array, u: Array, half_u: Array, q: Array, v: Array, half_v: Array) -> tuple[Array, Array]:
    """The closest points of the segments ``p ± half_u u`` and ``q ± half_v v`` with unit directions."""
    gap = q - p
    b, pu, qv = u @ v, u @ gap, v @ gap
    det = 1 - b * b
    s = jnp.where(det > 1e-8, (pu - b * qv) / jnp.where(det > 1e-8, det, 1.0), 0.5 * pu)
    s = jnp.clip(s, -half_u, half_u)
    t = jnp.clip(b * s - qv, -half_v, half_v)
    s = jnp.clip(pu + b * t, -half_u, half_u)
    return p + s * u, q + t * v
