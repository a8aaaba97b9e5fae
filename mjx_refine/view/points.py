"""Simulated flow at given pixels, object by object, without drawing a picture."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.compile_cache import jit_quickly
from mjx_refine.scene import Shape
from mjx_refine.view.distance import surface
from mjx_refine.view.frames import make_frames
from mjx_refine.view.outline import PIECE, Arrays, in_pieces, larger, padded


def point_flow_function(
    shapes: tuple[Shape, ...],
    arrays: Arrays,
    pixels: Float[Array, "*batch frames objects points 2"],
    image: tuple[int, int],
) -> Float[Array, "batch frames objects points 2"]:
    """``point_flow`` as a pure function of poses, sizes and cameras; its derivatives are finite everywhere."""
    poses, size, position, pitch, fovy = arrays
    batch, length = poses.shape[:2]
    frames = make_frames(poses, size, position, pitch, fovy, image[1])
    tiled = jnp.broadcast_to(pixels, (batch, *pixels.shape[-4:])).reshape(batch * length, *pixels.shape[-3:])
    focal = frames.focal[:, None]
    result = []
    for n, shape in enumerate(shapes):
        x, y = tiled[:, n, :, 0], tiled[:, n, :, 1]
        u, v = (x - image[0] / 2) / focal, -(y - image[1] / 2) / focal
        ray, origin, extent = frames.ray[:, n], frames.origin[:, n], frames.size[:, n]
        d = tuple(ray[:, i, 0, None] * u + ray[:, i, 1, None] * v - ray[:, i, 2, None] for i in range(3))
        o = tuple(origin[:, i, None] for i in range(3))
        # A ray that misses takes the point beside the object that is as far away as its centre.
        near, beside, seen = surface(shape, o, d, tuple(extent[:, i, None] for i in range(3)))
        t = jnp.where(seen, near, beside)
        hit = tuple(oi + t * di for oi, di in zip(o, d, strict=True))
        matrix, offset = frames.next_matrix[:, n], frames.next_offset[:, n]
        cx, cy, cz = (sum(matrix[:, i, j, None] * hit[j] for j in range(3)) + offset[:, i, None] for i in range(3))
        depth = larger(-cz, 0.02)
        result.append(jnp.stack([focal * cx / depth + image[0] / 2 - x, -focal * cy / depth + image[1] / 2 - y], -1))
    return jnp.stack(result, 1).reshape(batch, length, len(shapes), -1, 2)


_point_flow = jit_quickly(point_flow_function, static_argnums=(0, 3))


def point_flow(
    poses: Float[np.ndarray, "batch frames objects 7"],
    batch: SceneBatch,
    pixels: Float[np.ndarray, "*batch frames objects points 2"],
    image: tuple[int, int],
) -> Float[np.ndarray, "batch frames objects points 2"]:
    """Flow [px/frame] of each object's surface where it is seen at ``pixels`` (x, y) [px], as if nothing hid it.

    Where the ray misses the object, that of a point fixed to it beside its outline; zero in the last frame. ``pixels`` are the
    same for all of the batch, or each one's own.
    """
    where = np.asarray(pixels, np.float32)
    if where.ndim == 4:
        return in_pieces(lambda arrays: _point_flow(batch.shapes, arrays, where, image), poses, batch)
    parts = []
    for first in range(0, len(poses), PIECE):
        rows = slice(first, first + PIECE)
        own = np.concatenate([where[rows], np.repeat(where[:1], max(first + PIECE - len(poses), 0), 0)])
        found = _point_flow(batch.shapes, padded(poses[rows], batch[rows], (PIECE,)), own, image)
        parts.append(np.asarray(found))
    return np.concatenate(parts)[: len(poses)]
