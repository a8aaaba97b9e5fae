"""Contacts of two boxes as C MuJoCo has them: separating axes, then a clipped face or a pair of edges."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.sim.colliders.contact import Geom, Points

POINTS = 8
"""Corners of a quadrilateral cut by a rectangle, at most."""

FAR = 1.0
"""Distance of points that are no contact [m]."""

_PARALLEL = 1e-7
_I = np.repeat(np.arange(3), 3)
_J = np.tile(np.arange(3), 3)


class _Pair(NamedTuple):
    """Two boxes in the first one's frame: half sizes, the second's axes (columns) and its centre."""

    one: Float[Array, "3"]
    two: Float[Array, "3"]
    turn: Float[Array, "3 3"]
    apart: Float[Array, "3"]


def _face_axes(pair: _Pair) -> Float[Array, "6"]:
    """Gaps along the three face normals of each box; negative: overlap."""
    first = jnp.abs(pair.apart) - pair.one - jnp.abs(pair.turn) @ pair.two
    second = jnp.abs(pair.turn.T @ pair.apart) - pair.two - jnp.abs(pair.turn).T @ pair.one
    return jnp.concatenate([first, second])


def _edge_axes(pair: _Pair) -> tuple[Float[Array, "9 3"], Float[Array, "9"]]:
    """Unit cross products of the boxes' edges and the gaps along them; minus infinity where edges are parallel."""
    axes = jnp.cross(jnp.eye(3)[_I], pair.turn.T[_J])
    square = (axes * axes).sum(-1)
    parallel = square < _PARALLEL
    axes = axes / jnp.sqrt(jnp.where(parallel, 1.0, square))[:, None]
    reach = jnp.abs(axes) @ pair.one + jnp.abs(axes @ pair.turn) @ pair.two
    return axes, jnp.where(parallel, -jnp.inf, jnp.abs(axes @ pair.apart) - reach)


def box_box(first: Geom, second: Geom) -> Points:
    """Up to eight points (MuJoCo's ``mjc_BoxBox``, engine_collision_box.c, 3.17).

    The axis of least overlap is a face's normal or the cross product of two edges. A face's contact is the other box's
    facing side, clipped to the face, where it lies below it; two edges touch in one point.
    """
    turn = first[1].T @ second[1]
    pair = _Pair(first[2], second[2], turn, first[1].T @ (second[0] - first[0]))
    faces = _face_axes(pair)
    axes, edges = _edge_axes(pair)
    slack = 1e-6 * (first[2].sum() + second[2].sum())
    apart = (faces > slack).any() | (edges > slack).any()

    face = jnp.argmax(faces)
    edge = jnp.argmax(edges)
    axis = axes[edge]
    best = edges[edge]
    use_edge = best - 1e-6 * jnp.abs(best) > faces[face]
    # An edge axis within eight degrees of the face's normal duplicates it, unless it is clearly better.
    directions = jnp.concatenate([jnp.eye(3), turn.T])
    alias = jnp.abs(axis @ directions[face]) > 0.99
    use_edge &= ~(alias & (best < faces[face] + 0.05 * jnp.abs(faces[face])))

    d_face, p_face, n_face = _face_contact(pair, face)
    d_edge, p_edge, n_edge = _edge_contact(pair, jnp.asarray(_I)[edge], jnp.asarray(_J)[edge], axis)
    distance = jnp.where(use_edge, jnp.full(POINTS, FAR).at[0].set(d_edge), d_face)
    distance = jnp.where(apart, FAR, distance)
    position = jnp.where(use_edge, p_edge, p_face)
    normal = jnp.where(use_edge, n_edge, n_face)
    return distance, first[0] + position @ first[1].T, jnp.tile(first[1] @ normal, (POINTS, 1))


def _edge_contact(pair: _Pair, i: Array, j: Array, axis: Float[Array, "3"]):
    """Distance, position and normal of the crossing of edge direction ``i`` of the first box and ``j`` of the second."""
    axis = jnp.where(axis @ pair.apart < 0, -axis, axis)
    along_one = jnp.eye(3)[i]
    along_two = pair.turn[:, j]
    corner_one = jnp.where(axis >= 0, 1.0, -1.0) * pair.one * (1 - along_one)
    local = axis @ pair.turn
    corner_two = jnp.where(local >= 0, -1.0, 1.0) * pair.two * (1 - jnp.eye(3)[j])
    corner_two = pair.turn @ corner_two + pair.apart
    gap = corner_two - corner_one
    b = along_two[i]
    one_gap, two_gap = gap[i], along_two @ gap
    s = jnp.clip((one_gap - b * two_gap) / jnp.maximum(1 - b * b, 1e-12), -pair.one[i], pair.one[i])
    t = jnp.clip(b * s - two_gap, -pair.two[j], pair.two[j])
    s = jnp.clip(one_gap + b * t, -pair.one[i], pair.one[i])
    from_one = corner_one + along_one * s
    from_two = corner_two + along_two * t
    return (from_two - from_one) @ axis, 0.5 * (from_one + from_two), axis


def _face_contact(pair: _Pair, code: Array):
    """Distances (8), positions (8, 3) and the normal where ``code`` is the face axis: 0-2 of the first box, 3-5 second."""
    of_first = code < 3
    a = code % 3
    size = jnp.where(of_first, pair.one, pair.two)
    other = jnp.where(of_first, pair.two, pair.one)
    turn = jnp.where(of_first, pair.turn, pair.turn.T)
    centre = jnp.where(of_first, pair.apart, -pair.turn.T @ pair.apart)
    # The reference box's frame with the face's normal last, pointing to the other box.
    sign = jnp.where(centre[a] >= 0, 1.0, -1.0)
    order = jnp.stack([(a + 1) % 3, (a + 2) % 3, a])
    flip = jnp.stack([1.0, 1.0, sign])
    turn, centre, size = turn[order] * flip[:, None], centre[order] * flip, size[order]
    # The other box's side that faces the reference face most.
    b = jnp.argmax(jnp.abs(turn[2]))
    facing = jnp.where(turn[2, b] > 0, -1.0, 1.0)
    middle = centre + facing * other[b] * turn[:, b] - jnp.stack([0.0 * size[2], 0.0 * size[2], size[2]])
    u = other[(b + 1) % 3] * turn[:, (b + 1) % 3]
    v = other[(b + 2) % 3] * turn[:, (b + 2) % 3]
    points, valid = clip_quad(middle, u, v, size[:2])
    valid &= points[:, 2] <= 0
    chosen = jnp.argsort(~valid, stable=True)[:POINTS]
    points, valid = points[chosen], valid[chosen]
    distance = jnp.where(valid, points[:, 2], FAR)
    local = points.at[:, 2].set(size[2] + 0.5 * points[:, 2]) * flip
    place = jnp.argsort(order)
    local = local[:, place]
    normal = (jnp.array([0.0, 0.0, 1.0]) * flip)[place]
    position = jnp.where(of_first, local, pair.apart + local @ pair.turn.T)
    normal = jnp.where(of_first, normal, -pair.turn @ normal)
    return distance, position, normal


def clip_quad(middle: Float[Array, "3"], u: Float[Array, "3"], v: Float[Array, "3"], limit: Float[Array, "2"]):
    """Corners of the parallelogram ``middle ± u ± v`` cut to ``|x| <= limit[0], |y| <= limit[1]``.

    Returns:
      12 points of which at most 8 are corners, and which are.
    """
    su = np.array([1.0, -1.0, -1.0, 1.0], np.float32)[:, None]
    sv = np.array([1.0, 1.0, -1.0, -1.0], np.float32)[:, None]
    start = middle + su * u + sv * v
    way = jnp.roll(start, -1, axis=0) - start
    # Liang-Barsky: the part of every side between its entry into and its exit from the rectangle.
    bound = jnp.concatenate([limit, limit])
    speed = jnp.concatenate([way[:, :2], -way[:, :2]], -1)
    room = bound - jnp.concatenate([start[:, :2], -start[:, :2]], -1)
    crossing = room / jnp.where(speed == 0, 1.0, speed)
    enter = jnp.where(speed < 0, crossing, jnp.where((speed == 0) & (room < 0), jnp.inf, 0.0)).max(-1)
    leave = jnp.where(speed > 0, crossing, jnp.inf).min(-1)
    enter = jnp.maximum(enter, 0.0)
    inside = enter <= leave
    inside &= enter <= 1
    entries = start + jnp.clip(enter, 0, 1)[:, None] * way
    exits = start + jnp.clip(leave, 0, 1)[:, None] * way
    # A side that is still inside at its end shares that end with the next one's start.
    leaving = inside & (leave < 1) & (leave > enter)
    corners = jnp.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) * limit
    offset = corners - middle[:2]
    area = u[0] * v[1] - u[1] * v[0]
    area = jnp.where(jnp.abs(area) < 1e-12, 1e-12, area)
    on_u = (offset[:, 0] * v[1] - offset[:, 1] * v[0]) / area
    on_v = (offset[:, 1] * u[0] - offset[:, 0] * u[1]) / area
    covered = (jnp.abs(on_u) < 1) & (jnp.abs(on_v) < 1)
    height = middle[2] + on_u * u[2] + on_v * v[2]
    points = jnp.concatenate([entries, exits, jnp.concatenate([corners, height[:, None]], -1)])
    return points, jnp.concatenate([inside, leaving, covered])
