"""Nearest hits of rays with spheres, boxes, cylinders and the floor, elementwise.

Nothing here multiplies matrices: XLA then fuses rays, hits, flow and the sums of the score into one kernel.
Rays start outside the objects; an object around the camera is not seen.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjx_refine.scene import Shape
from mjx_refine.view.frames import Frames

FAR = 1e9
"""Ray parameter of a miss."""

_Vector = tuple[Array, ...]


def _sphere(o: _Vector, d: _Vector, size: _Vector) -> Array:
    dd = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    along = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / dd
    # The distance from the centre to the ray, not b^2 - 4ac: that one cancels for small spheres far away.
    px, py, pz = (oi + along * di for oi, di in zip(o, d, strict=True))
    gap = size[0] * size[0] - (px * px + py * py + pz * pz)
    t = along - jnp.sqrt(jnp.maximum(gap, 0.0) / dd)
    return jnp.where((gap > 0.0) & (t > 0.0), t, FAR)


def safe(x: Array) -> Array:
    """``x``, kept off zero so that it can be divided by."""
    return jnp.where(jnp.abs(x) < 1e-12, jnp.where(x < 0, -1e-12, 1e-12), x)


def slabs(o: _Vector, d: _Vector, size: _Vector) -> tuple[list[Array], list[Array]]:
    """Where rays o + t d enter and leave each of the three slabs of a box (Kay & Kajiya, SIGGRAPH 1986)."""
    nears, fars = [], []
    for oi, di, si in zip(o, d, size, strict=True):
        inverse = 1.0 / safe(di)
        middle, half = -oi * inverse, si * jnp.abs(inverse)
        nears.append(middle - half)
        fars.append(middle + half)
    return nears, fars


def _box(o: _Vector, d: _Vector, size: _Vector) -> Array:
    nears, fars = slabs(o, d, size)
    near, far = functools.reduce(jnp.maximum, nears), functools.reduce(jnp.minimum, fars)
    return jnp.where((near < far) & (near > 0.0), near, FAR)


def _cylinder(o: _Vector, d: _Vector, size: _Vector) -> Array:
    radius, half = size[0], size[1]
    across = safe(d[0] * d[0] + d[1] * d[1])
    along = -(o[0] * d[0] + o[1] * d[1]) / across
    px, py = o[0] + along * d[0], o[1] + along * d[1]
    gap = radius * radius - (px * px + py * py)
    reach = jnp.sqrt(jnp.maximum(gap, 0.0) / across)
    inverse = 1.0 / safe(d[2])
    middle, width = -o[2] * inverse, half * jnp.abs(inverse)
    near = jnp.maximum(along - reach, middle - width)
    far = jnp.minimum(along + reach, middle + width)
    return jnp.where((gap > 0.0) & (near < far) & (near > 0.0), near, FAR)


HIT = {"sphere": _sphere, "box": _box, "cylinder": _cylinder}


def cast(
    shapes: tuple[Shape, ...],
    frames: Frames,
    x: Float[Array, "frames pixels"],
    y: Float[Array, "frames pixels"],
    centre: tuple[float, float],
) -> tuple[Int[Array, "frames pixels"], Float[Array, "frames pixels"], Float[Array, "frames pixels"]]:
    """Ids (0 background, k + 1 for object k) and flow (x right, y down) [px] at image coordinates ``x``, ``y`` [px].

    Pixel (r, c) has its centre at (c + 0.5, r + 0.5); ``centre`` is the principal point [px].
    The flow is that of the material point seen: it moves with its body to the next frame and is projected again.
    """
    focal = frames.focal[:, None]
    u, v = (x - centre[0]) / focal, -(y - centre[1]) / focal
    down = frames.down[:, 0, None] * u + frames.down[:, 1, None] * v - frames.down[:, 2, None]
    best = jnp.where(down < -1e-9, -frames.height[:, None] / jnp.minimum(down, -1e-9), FAR)
    best = jnp.where(best > 0.0, best, FAR)
    ids = jnp.zeros(x.shape, jnp.int32)
    flow_x = flow_y = jnp.zeros_like(x)
    for k, shape in enumerate(shapes):
        ray, origin, size = frames.ray[:, k], frames.origin[:, k], frames.size[:, k]
        d = tuple(ray[:, i, 0, None] * u + ray[:, i, 1, None] * v - ray[:, i, 2, None] for i in range(3))
        o = tuple(origin[:, i, None] for i in range(3))
        t = HIT[shape](o, d, tuple(size[:, i, None] for i in range(3)))
        nearer = t < best
        best = jnp.where(nearer, t, best)
        ids = jnp.where(nearer, k + 1, ids)
        hit = tuple(oi + t * di for oi, di in zip(o, d, strict=True))
        matrix, offset = frames.next_matrix[:, k], frames.next_offset[:, k]
        cx, cy, cz = (
            matrix[:, i, 0, None] * hit[0]
            + matrix[:, i, 1, None] * hit[1]
            + matrix[:, i, 2, None] * hit[2]
            + offset[:, i, None]
            for i in range(3)
        )
        # A point that passes behind the camera has no flow; a large depth keeps it finite.
        depth = jnp.where(cz < -1e-6, -cz, FAR)
        flow_x = jnp.where(nearer, focal * cx / depth + centre[0] - x, flow_x)
        flow_y = jnp.where(nearer, -focal * cy / depth + centre[1] - y, flow_y)
    return ids, flow_x, flow_y
