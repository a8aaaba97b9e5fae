"""Outlines of bodies as support functions of their silhouettes: exact, smooth in the pose, without drawing a pixel.

Everything but ``supports`` is a pure function of arrays that JAX can differentiate and vectorise, in the arrays' own
precision. Coordinates of the camera are here those of the picture: right, down, ahead.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.scene import Shape
from mjx_refine.view.frames import camera_matrix, rotation_matrix

BATCHES = (8, 32, 128)
"""Batch sizes that are compiled; larger batches are multiples of the last."""

PIECE = 32
"""Rows in one call where a batch of more than so many is taken in pieces."""

NEAR = 0.02
"""Depth [m] in front of which an object is moved ahead: no picture of it is bounded there."""

CORNERS = tuple((x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1))
"""A box's corners in half extents; corner 4 i + 2 j + k has signs i, j, k."""

Arrays = tuple[
    Float[Array, "batch frames objects 7"],
    Float[Array, "batch objects 3"],
    Float[Array, "batch 3"],
    Float[Array, "batch"],
    Float[Array, "batch"],
]
"""Poses [m, unit quaternion wxyz], ``geom_size`` [m], camera position [m], pitch [rad] and vertical field of view [rad]."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Placed:
    """Objects in coordinates of the camera: right, down, ahead.

    Attributes:
      centre: [m].
      shown: the centre, moved ahead where the object reaches the camera's plane, so that its picture is bounded [m].
      nearest: depth of the object's nearest point [m].
      axes: column j is the object's axis j.
      size: MuJoCo's ``geom_size`` [m].
      focal: focal length [px].
    """

    centre: Float[Array, "batch frames objects 3"]
    shown: Float[Array, "batch frames objects 3"]
    nearest: Float[Array, "batch frames objects"]
    axes: Float[Array, "batch frames objects 3 3"]
    size: Float[Array, "batch 1 objects 3"]
    focal: Float[Array, "batch 1 1"]


def directions(count: int) -> Float[np.ndarray, "directions 2"]:
    """Unit vectors in the image, evenly spaced, the first to the right."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def larger(a: Array, b: Array | float) -> Array:
    """The larger of two, elementwise. The derivative of ``jnp.maximum`` asks which operand equals the result; XLA may
    compute the two with different rounding, and none does."""
    return jnp.where(a > b, a, b)


def smaller(a: Array, b: Array | float) -> Array:
    """Ditto, the smaller."""
    return jnp.where(a < b, a, b)


def camera_axes(pitch: Float[Array, "batch"]) -> Float[Array, "batch 3 3"]:
    """The picture's right, down and ahead in the world, as columns."""
    return camera_matrix(pitch) * jnp.asarray([1.0, -1.0, -1.0], pitch.dtype)


def _ahead(nearest: Array) -> Array:
    """Depth of the nearest point of the object as it is shown: once differentiable, between NEAR / 2 and NEAR behind."""
    lack = larger(NEAR - nearest, 0.0) / NEAR
    return 0.5 * NEAR * (1.0 + 1.0 / (1.0 + 2.0 * lack))


def place(shapes: tuple[Shape, ...], arrays: Arrays, image: tuple[int, int]) -> Placed:
    """Objects as the camera has them; ``image`` is (width, height) [px]."""
    poses, size, position, pitch, fovy = arrays
    camera = camera_axes(pitch)[:, None, None]
    offset = poses[..., :3] - position[:, None, None]
    # Written out: a batched matrix product of this size is slow on every device.
    centre = (camera * offset[..., :, None]).sum(-2)
    # What follows is consistent for rotations only; a step along a derivative leaves the unit quaternions.
    norm = jnp.sqrt(larger((poses[..., 3:] ** 2).sum(-1, keepdims=True), 1e-12))
    axes = (camera[..., :, :, None] * rotation_matrix(poses[..., 3:] / norm)[..., :, None, :]).sum(-3)
    extent = jnp.broadcast_to(size[:, None], centre.shape)
    reaches = []
    for n, shape in enumerate(shapes):
        along, half = axes[:, :, n, 2], extent[:, :, n]
        if shape == "sphere":
            reaches.append(half[..., 0])
        elif shape == "cylinder":
            # A thousandth of the radius too much face on, where the square root has no derivative.
            across = jnp.sqrt(along[..., 0] ** 2 + along[..., 1] ** 2 + 1e-6)
            reaches.append(half[..., 0] * across + half[..., 1] * jnp.abs(along[..., 2]))
        else:
            reaches.append((half * jnp.abs(along)).sum(-1))
    reach = jnp.stack(reaches, -1)
    nearest = centre[..., 2] - reach
    depth = jnp.where(nearest < NEAR, reach + _ahead(nearest), centre[..., 2])
    shown = jnp.concatenate([centre[..., :2], depth[..., None]], -1)
    focal = ((image[1] / 2) / jnp.tan(fovy / 2))[:, None, None]
    return Placed(centre, shown, nearest, axes, size[:, None], focal)


def corners(placed: Placed, n: int) -> Float[Array, "batch frames 8 2"]:
    """Box ``n``'s corners in the picture, from the principal point [px]."""
    signs = jnp.asarray(CORNERS, placed.size.dtype) * placed.size[:, :, n, None]
    x, y, depth = ((placed.axes[:, :, n, None, i] * signs).sum(-1) + placed.shown[:, :, n, None, i] for i in range(3))
    scale = placed.focal / larger(depth, 0.25 * NEAR)
    return jnp.stack([scale * x, scale * y], -1)


def _rim(centre: Array, axis: Array, radius: Array, nx: Array, ny: Array) -> Array:
    """Support of the perspective picture of a circle, over the focal length.

    The line n . p = s is a plane through the camera with normal l = (n, -s). It touches the circle with centre m, unit
    axis a and radius r where l . m + r |l - (l . a) a| = 0: a quadratic in s. With t the picture's direction across n,
    its discriminant is r^2 times (a.t)^2 ((n.m)^2 + m_d^2 - r^2) + ((a.n) (n.m) + a_d m_d)^2, a sum without cancellation.
    """
    mx, my, md = (centre[..., i, None] for i in range(3))
    ax, ay, ad = (axis[..., i, None] for i in range(3))
    radius = radius[..., None]
    beside, lean, across = nx * mx + ny * my, nx * ax + ny * ay, nx * ay - ny * ax
    square = radius * radius
    leading = md * md - square * (ax * ax + ay * ay)
    inner = across * across * (beside * beside + md * md - square) + (lean * beside + ad * md) ** 2
    # Seen edge on, a circle has a corner; a millionth of its radius rounds it.
    root = jnp.sqrt(larger(inner, 0.0) + 1e-12 * md * md)
    return (beside * md + square * lean * ad + radius * root) / leading


def _sphere(centre: Array, radius: Array, nx: Array, ny: Array) -> Array:
    """Ditto of a sphere: l . m + r |l| = 0."""
    mx, my, md = (centre[..., i, None] for i in range(3))
    radius = radius[..., None]
    beside, leading = nx * mx + ny * my, (md - radius) * (md + radius)
    return (beside * md + radius * jnp.sqrt(beside * beside + leading)) / leading


def support_of(shape: Shape, placed: Placed, n: int, normals: Array) -> Float[Array, "batch frames directions"]:
    """Support function of object ``n``'s silhouette from the principal point [px].

    Args:
      shape: its shape.
      placed: all objects.
      n: which one.
      normals: unit vectors, (directions, 2) or (batch, frames, directions, 2).
    """
    nx, ny = normals[..., 0], normals[..., 1]
    centre, axis, size = placed.shown[:, :, n], placed.axes[:, :, n, :, 2], placed.size[:, :, n]
    if shape == "sphere":
        return placed.focal * _sphere(centre, size[..., 0], nx, ny)
    if shape == "cylinder":
        half = size[..., 1, None] * axis
        ends = (_rim(centre + sign * half, axis, size[..., 0], nx, ny) for sign in (1, -1))
        return placed.focal * functools.reduce(larger, ends)
    points = corners(placed, n)
    # Corner by corner: nothing of the size corners times directions is written to memory.
    reach = (points[:, :, k, 0, None] * nx + points[:, :, k, 1, None] * ny for k in range(8))
    return functools.reduce(larger, reach)


def support_function(
    shapes: tuple[Shape, ...], arrays: Arrays, count: int, image: tuple[int, int]
) -> Float[Array, "batch frames objects directions"]:
    """How far each silhouette reaches in each of ``count`` directions of the image [px]; pure, for ``jax.jit``.

    Exact and with exact derivatives wherever the outline has one contact point; finite everywhere.
    """
    placed = place(shapes, arrays, image)
    normals = jnp.asarray(directions(count), placed.centre.dtype)
    middle = 0.5 * image[0] * normals[:, 0] + 0.5 * image[1] * normals[:, 1]
    return jnp.stack([support_of(shape, placed, n, normals) for n, shape in enumerate(shapes)], 2) + middle


def padded(
    poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch, sizes: tuple[int, ...] = BATCHES
) -> Arrays:
    """Poses, sizes and cameras in single precision, rows added up to the next of ``sizes`` or a multiple of the last.

    Few sizes are ever compiled: searches ask for batches of many lengths. They are left on the host: a compiled program takes
    them from there in a fraction of the time that ``jnp.asarray`` takes.
    """
    arrays = (poses, batch.size, batch.camera_position, batch.camera_pitch, batch.camera_fovy)
    size = next((b for b in sizes if b >= len(poses)), -(-len(poses) // sizes[-1]) * sizes[-1])
    # Rounded here: on the device it is a program of its own for each.
    return tuple(  # type: ignore[return-value]
        np.concatenate([a, np.repeat(a[:1], size - len(a), 0)], dtype=np.float32) for a in map(np.asarray, arrays)
    )


def in_pieces(
    function: Callable[[Arrays], Array], poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch
) -> Float[np.ndarray, "batch ..."]:
    """``function`` of ``padded`` arrays, which takes each row by itself: 39 rows are two pieces of 32 then, not 128."""
    if len(poses) <= PIECE:
        return np.asarray(function(padded(poses, batch)))[: len(poses)]
    parts, first = [], 0
    while first < len(poses):
        size = PIECE if len(poses) - first <= BATCHES[-1] - PIECE else BATCHES[-1]
        rows = slice(first, first + size)
        parts.append(function(padded(poses[rows], batch[rows], (size,))))
        first += size
    return np.concatenate([np.asarray(part) for part in parts])[: len(poses)]


_support_function = jax.jit(support_function, static_argnums=(0, 2, 3))


def supports(
    poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch, image: tuple[int, int], count: int
) -> Float[np.ndarray, "batch frames objects directions"]:
    """How far each silhouette reaches in each of ``count`` directions of the image [px].

    The support function of a convex outline, h(n) = max over its points p of n . p (Schneider, Convex Bodies, 1.7).
    Occlusion and the image's border do not matter to it.
    """
    return in_pieces(lambda arrays: _support_function(batch.shapes, arrays, count, image), poses, batch)
