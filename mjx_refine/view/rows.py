"""Rays of rows of a picture, each with its own moment: hits of objects, of changed outlines, of the floor, and their flow."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_refine.scene import Shape
from mjx_refine.view.distance import distance_of, surface
from mjx_refine.view.frames import Frames, make_frames
from mjx_refine.view.outline import directions, larger, place, support_of
from mjx_refine.view.rays import FAR, cast

DISTANCE = 50.0
"""Depth of the background above the horizon [m]."""

PART = 4096
"""Points that are compared with changed outlines at a time: each with a hundred normals of every outline."""

SIDES = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
"""Normals of the rectangle around an outline."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rows:
    """S rows (or whole pictures) with one moment each; N objects and, last, the floor.

    Attributes:
      poses: at the row's moment and one frame later [m, unit quaternion wxyz].
      size: MuJoCo's ``geom_size`` [m].
      position: the camera's [m].
      pitch: the camera's [rad].
      fovy: vertical field of view [rad].
      line: which points belong to it.
      instant: which change of the outlines belongs to it.
    """

    poses: Float[Array, "steps 2 bodies 7"]
    size: Float[Array, "steps bodies 3"]
    position: Float[Array, "steps 3"]
    pitch: Float[Array, "steps"]
    fovy: Float[Array, "steps"]
    line: Int[Array, "steps"]
    instant: Int[Array, "steps"]


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def cast_rows(
    shapes: tuple[Shape, ...],
    image: tuple[int, int],
    moving: bool,
    rows: Rows,
    points: Float[Array, "lines points 2"],
    visible: Bool[Array, "lines points"],
    change: Float[Array, "instants objects directions"] | None,
) -> tuple[Int[Array, "steps points"], Float[Array, "steps points 2"]]:
    """Ids (0 background) and flow [px] at ``points`` of the straight picture.

    Args:
      shapes: of the objects.
      image: (width, height) [px].
      moving: whether the background flows.
      rows: moments and what is seen there.
      points: (x, y) [px].
      visible: where objects can be seen.
      change: what is added to the outlines' support functions [px]; None: nothing.
    """
    made = make_frames(rows.poses, rows.size, rows.position, rows.pitch, rows.fovy, image[1])
    made = jax.tree.map(lambda a: a[::2], made)
    made = dataclasses.replace(made, down=made.ray[:, -1, 2], height=made.origin[:, -1, 2])
    centre = (image[0] / 2, image[1] / 2)

    def one(step: tuple[Frames, Rows]):
        frames, row = jax.tree.map(lambda a: a[None], step)
        at = points[row.line[0]]
        x, y = at[None, :, 0], at[None, :, 1]
        if change is None:
            ids, flow_x, flow_y = cast(shapes, frames, x, y, centre)
        else:
            arrays = (row.poses[:, :1, :-1], row.size[:, :-1], row.position, row.pitch, row.fovy)
            ids, flow_x, flow_y = _changed_outlines(shapes, frames, arrays, at, image, change[row.instant[0]])
        ids = jnp.where(visible[row.line], ids, 0)
        ground = _ground_flow(frames, x, y, centre) if moving else (0.0, 0.0)
        flow_x, flow_y = jnp.where(ids > 0, flow_x, ground[0]), jnp.where(ids > 0, flow_y, ground[1])
        return ids[0], jnp.stack([flow_x[0], flow_y[0]], -1)

    return jax.lax.map(one, (made, rows))


def _ray(frames: Frames, k: int, x: Array, y: Array, centre: tuple[float, float]):
    """Origin and direction of the points' rays in body ``k``'s frame."""
    focal = frames.focal[:, None]
    u, v = (x - centre[0]) / focal, -(y - centre[1]) / focal
    ray, origin = frames.ray[:, k], frames.origin[:, k]
    d = tuple(ray[:, i, 0, None] * u + ray[:, i, 1, None] * v - ray[:, i, 2, None] for i in range(3))
    return tuple(origin[:, i, None] for i in range(3)), d


def _followed(frames: Frames, k: int, hit: tuple[Array, ...], x: Array, y: Array, centre: tuple[float, float]):
    """Flow of points of body ``k``."""
    matrix, offset, focal = frames.next_matrix[:, k], frames.next_offset[:, k], frames.focal[:, None]
    cx, cy, cz = (sum(matrix[:, i, j, None] * hit[j] for j in range(3)) + offset[:, i, None] for i in range(3))
    depth = jnp.where(cz < -1e-6, -cz, FAR)
    return focal * cx / depth + centre[0] - x, -focal * cy / depth + centre[1] - y


def _ground_flow(frames: Frames, x: Array, y: Array, centre: tuple[float, float]):
    """Flow of the floor, and above its horizon of what is ``DISTANCE`` away."""
    o, d = _ray(frames, frames.ray.shape[1] - 1, x, y, centre)
    reach = jnp.where(d[2] < -1e-3, -o[2] / jnp.minimum(d[2], -1e-3), DISTANCE)
    reach = jnp.clip(reach, 0.05, DISTANCE)
    hit = tuple(oi + reach * di for oi, di in zip(o, d, strict=True))
    return _followed(frames, frames.ray.shape[1] - 1, hit, x, y, centre)


def _changed_outlines(shapes, frames: Frames, arrays, at: Array, image: tuple[int, int], change: Array):
    """``_cast_outlines`` by ``_changed_distance``, looked at in the rectangles around the outlines alone, ``PART`` points at
    a time: elsewhere no outline can be."""
    points, few = len(at), min(PART, len(at))
    half = jnp.asarray([image[0] / 2, image[1] / 2], at.dtype)
    placed, centre = place(shapes, arrays, image), (image[0] / 2, image[1] / 2)
    near = jnp.zeros(points, bool)
    for n, shape in enumerate(shapes):
        wide = larger(jnp.where(jnp.isnan(change[n]), 0.0, change[n]).max(), 0.0)
        right, left, top, bottom = support_of(shape, placed, n, jnp.asarray(SIDES, at.dtype))[0, 0] + wide
        x, y = (at - half).T
        near = near | ((x <= right) & (-x <= left) & (y <= top) & (-y <= bottom))
    chosen = jnp.nonzero(near, size=-(-points // few) * few, fill_value=points)[0]

    def some(k: Array, found: tuple[Array, ...]) -> tuple[Array, ...]:
        index = jax.lax.dynamic_slice(chosen, (k * few,), (few,))
        part = at[jnp.minimum(index, points - 1)]
        distance = _changed_distance(shapes, arrays, part, image, change)
        told = _cast_outlines(shapes, frames, part[None, :, 0], part[None, :, 1], centre, distance)
        return tuple(a.at[0, index].set(b[0], mode="drop") for a, b in zip(found, told, strict=True))

    nothing = jnp.zeros((1, points), jnp.int32), jnp.zeros((1, points), at.dtype), jnp.zeros((1, points), at.dtype)
    return jax.lax.fori_loop(0, -(-near.sum() // few), some, nothing)


def _changed_distance(
    shapes, arrays, at: Array, image: tuple[int, int], change: Array
) -> Float[Array, "objects points"]:
    """Signed distance to outlines whose support functions have grown by ``change`` [px].

    The distance to the outline as it is, along its own edges, and the difference of two maxima of n . x - h(n) over the
    directions of ``change``, in which what is lost between directions cancels.
    """
    placed = place(shapes, arrays, image)
    shifted = at - jnp.asarray([image[0] / 2, image[1] / 2], at.dtype)
    normals = jnp.asarray(directions(change.shape[-1]), at.dtype)
    along = shifted[:, :1] * normals[:, 0] + shifted[:, 1:] * normals[:, 1]
    result = []
    for n, shape in enumerate(shapes):
        plain = distance_of(shape, placed, n, shifted, 64)[0, 0]
        reach = support_of(shape, placed, n, normals)[0, 0]
        # Where an effect hides a direction nothing is left.
        wide = jnp.where(jnp.isnan(change[n]), -FAR, change[n])
        result.append(plain + (along - reach - wide).max(-1) - (along - reach).max(-1))
    return jnp.stack(result)


def _cast_outlines(shapes, frames: Frames, x: Array, y: Array, centre, distance: Array):
    """``cast`` with silhouettes where ``distance`` is not positive; beside the body, its nearest point's depth counts."""
    o, d = _ray(frames, frames.ray.shape[1] - 1, x, y, centre)
    floor = jnp.where(d[2] < -1e-9, -o[2] / jnp.minimum(d[2], -1e-9), FAR)
    best = floor = jnp.where(floor > 0.0, floor, FAR)
    ids = jnp.zeros(x.shape, jnp.int32)
    flow_x = flow_y = jnp.zeros_like(x)
    for k, shape in enumerate(shapes):
        o, d = _ray(frames, k, x, y, centre)
        near, beside, hit = surface(shape, o, d, tuple(frames.size[:, k, i, None] for i in range(3)))
        # What an outline has more than its body stands on the floor, not in it.
        t = jnp.where(hit, near, jnp.minimum(beside, 0.999 * floor))
        nearer = (distance[k][None] <= 0.0) & (t > 0.0) & (t < best)
        best, ids = jnp.where(nearer, t, best), jnp.where(nearer, k + 1, ids)
        place_ = tuple(oi + t * di for oi, di in zip(o, d, strict=True))
        moved_x, moved_y = _followed(frames, k, place_, x, y, centre)
        flow_x, flow_y = jnp.where(nearer, moved_x, flow_x), jnp.where(nearer, moved_y, flow_y)
    return ids, flow_x, flow_y
