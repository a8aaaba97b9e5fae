"""Contacts of a box and of a cylinder with a plane, point for point as C MuJoCo has them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from mjx_refine.sim.colliders.contact import Geom, Points

_CORNERS = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float32)


def plane_box(plane: Geom, box: Geom) -> Points:
    """The four corners below the box's centre (MuJoCo's ``mjc_PlaneBox``).

    Of two opposite corners one is below the centre, so there are always four. MJX keeps only those within 1 mm of the
    deepest: a box that rocks on a soft floor then stands on an edge where MuJoCo's stands on a face.
    """
    normal = plane[1][:, 2]
    arms = (jnp.asarray(_CORNERS[:4]) * box[2]) @ box[1].T
    height = arms @ normal
    arms = jnp.where(height[:, None] > 0, -arms, arms)
    distance = (box[0] - plane[0]) @ normal - jnp.abs(height)
    return distance, box[0] + arms - 0.5 * distance[:, None] * normal, jnp.tile(normal, (4, 1))


def plane_cylinder(plane: Geom, cylinder: Geom) -> Points:
    """The lowest points of both caps' rims, and two more of the lower rim (MuJoCo's ``mjc_PlaneCylinder``)."""
    normal = plane[1][:, 2]
    radius, half = cylinder[2][0], cylinder[2][1]
    axis = cylinder[1][:, 2]
    slope = normal @ axis
    axis = jnp.where(slope > 0, -axis, axis)
    slope = -jnp.abs(slope)
    centre = (cylinder[0] - plane[0]) @ normal
    # Downhill direction in the caps' planes; any serves where the cylinder stands upright.
    down = axis * slope - normal
    square = down @ down
    upright = square < 1e-12
    down = jnp.where(upright, cylinder[1][:, 0], down / jnp.sqrt(jnp.where(upright, 1.0, square))) * radius
    side = jnp.cross(down, axis) * (np.sqrt(3.0) / 2)
    axis = axis * half
    arms = jnp.stack([down + axis, down - axis, side + axis - 0.5 * down, axis - side - 0.5 * down])
    distance = centre + arms @ normal
    # MuJoCo asks for the others only where the lowest point touches.
    distance = jnp.where(distance[0] > 0, jnp.maximum(distance, 1e-3), distance)
    return distance, cylinder[0] + arms - 0.5 * distance[:, None] * normal, jnp.tile(normal, (4, 1))
