"""What a collider takes and gives, and how MJX's collision driver wants it."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_refine.sim.mjx_import import mjx

GeomType = mjx.GeomType

Geom = tuple[Float[Array, "3"], Float[Array, "3 3"], Float[Array, "3"]]
"""Position [m], rotation (columns are the geom's axes in the world) and ``geom_size`` [m]."""

Points = tuple[Float[Array, " points"], Float[Array, "points 3"], Float[Array, "points 3"]]
"""Distance (positive: no contact), position and normal from the first geom to the second, of every contact point."""


def frames_of(normal: Float[Array, "points 3"]) -> Float[Array, "points 3 3"]:
    """Contact frames: rows are the normal and two tangents, chosen as C MuJoCo's ``mju_makeFrame`` does."""
    upright = (jnp.abs(normal[:, 1]) < 0.5)[:, None]
    other = jnp.where(upright, jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    first = other - (other * normal).sum(-1, keepdims=True) * normal
    first = first / jnp.linalg.norm(first, axis=-1, keepdims=True)
    return jnp.stack([normal, first, jnp.cross(normal, first)], 1)


def as_mjx(function: Callable[[Geom, Geom], Points], points: int) -> Callable:
    """``function`` of two geoms in the form that MJX's collision driver calls."""

    def collide(model, data, _key, geom):
        def one(first, second):
            sides = ((data.geom_xpos[g], data.geom_xmat[g], model.geom_size[g]) for g in (first, second))
            distance, position, normal = function(*sides)
            return distance, position, frames_of(normal)

        found = jax.vmap(one)(geom[:, 0], geom[:, 1])
        return jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:]), found)

    collide.ncon = points
    return collide
