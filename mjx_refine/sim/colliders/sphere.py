"""Contacts of a sphere with a box and with a cylinder, as C MuJoCo has them."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_refine.sim.colliders.contact import Geom, Points


def _safe_norm(vector: Float[Array, "3"]) -> Float[Array, ""]:
    """The length, with gradient zero instead of NaN at zero."""
    square = vector @ vector
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def _point(distance: Float[Array, ""], position: Float[Array, "3"], normal: Float[Array, "3"]) -> Points:
    return distance[None], position[None], normal[None]


def sphere_box(sphere: Geom, box: Geom) -> Points:
    """One point: towards the closest point of the box, or out of its nearest face (``mjc_SphereBox``)."""
    radius, half = sphere[2][0], box[2]
    centre = box[1].T @ (sphere[0] - box[0])
    nearest = jnp.clip(centre, -half, half)
    towards = nearest - centre
    away = _safe_norm(towards)
    inside = away <= 1e-9
    # Outside: the normal points from the sphere to the box.
    outer = towards / jnp.where(inside, 1.0, away)
    # Inside: out of the nearest face.
    gaps = half - jnp.abs(centre)
    face = jnp.arange(3) == jnp.argmin(gaps)
    depth = gaps.min()
    inner = jnp.where(face, jnp.where(centre >= 0, -1.0, 1.0), 0.0)
    normal = jnp.where(inside, inner, outer)
    distance = jnp.where(inside, -depth, away) - radius
    position = jnp.where(inside, centre + inner * (radius - depth) / 2, 0.5 * (nearest + centre + outer * radius))
    return _point(distance, box[0] + box[1] @ position, box[1] @ normal)


def sphere_cylinder(sphere: Geom, cylinder: Geom) -> Points:
    """One point, on the cylinder's side, a cap or a rim (``mjc_SphereCylinder``)."""
    radius, half = cylinder[2][0], cylinder[2][1]
    centre = cylinder[1].T @ (sphere[0] - cylinder[0])
    along, across = centre[2], centre.at[2].set(0.0)
    reach = _safe_norm(across)
    beside, over = jnp.abs(along) < half, reach < radius
    within = beside & over
    cap_nearer = half - jnp.abs(along) < radius - reach
    on_side = beside & (~over | ~cap_nearer)
    on_cap = over & (~beside | (within & cap_nearer))
    sign = jnp.where(along > 0, 1.0, -1.0)
    out = jnp.where(reach > 0, across / jnp.where(reach > 0, reach, 1.0), jnp.array([1.0, 0.0, 0.0]))
    up = jnp.array([0.0, 0.0, 1.0]) * sign
    corner = out * radius + up * half - centre
    away = _safe_norm(corner)
    to_corner = jnp.where(away > 0, corner / jnp.where(away > 0, away, 1.0), -out)
    normal = jnp.where(on_side, -out, jnp.where(on_cap, -up, to_corner))
    surface = jnp.where(on_side, reach - radius, jnp.where(on_cap, jnp.abs(along) - half, away))
    distance = surface - sphere[2][0]
    position = centre + normal * (sphere[2][0] + 0.5 * distance)
    return _point(distance, cylinder[0] + cylinder[1] @ position, cylinder[1] @ normal)
