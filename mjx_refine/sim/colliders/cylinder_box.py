"""Contacts of a cylinder with a box, which MJX-JAX lacks, as C MuJoCo's convex collider has them."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.sim.colliders.contact import Geom, Points
from mjx_refine.sim.colliders.directions import closest_on_lines, least_on_circle, towards, unit
from mjx_refine.sim.parallel import ALIGNED, SQUARE

FAR = 1.0
_UP = np.array([0.0, 0.0, 1.0], np.float32)
_CORNERS = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float32)


class _Pair(NamedTuple):
    """In the cylinder's frame: its radius and half height, the box's half sizes, axes (columns) and centre."""

    radius: Float[Array, ""]
    half: Float[Array, ""]
    size: Float[Array, "3"]
    turn: Float[Array, "3 3"]
    apart: Float[Array, "3"]


def _overlap(pair: _Pair, n: Float[Array, "3"]) -> Float[Array, ""]:
    across = jnp.sqrt(jnp.maximum(n[0] ** 2 + n[1] ** 2, 1e-20))
    return pair.radius * across + pair.half * jnp.abs(n[2]) + pair.size @ jnp.abs(n @ pair.turn) - pair.apart @ n


def _direction(pair: _Pair) -> tuple[Float[Array, "3"], Array, Float[Array, ""]]:
    """The direction of least overlap, its kind (0-2 box faces, 3 cap, 4-6 edges, 7-14 corners, 15-17 rim), the depth."""
    d, axes = pair.apart, pair.turn.T
    cross = jnp.cross(_UP, axes)
    parallel = (cross * cross).sum(-1) < 1e-8
    corners = (d - (_CORNERS * pair.size) @ axes) * jnp.array([1.0, 1.0, 0.0])

    def slope(n: Float[Array, "3"]) -> Float[Array, "3"]:
        return pair.half * jnp.sign(n[2]) * _UP + pair.turn @ (pair.size * jnp.sign(n @ pair.turn)) - d

    def circle(pole: Float[Array, "3"], k: Array) -> Float[Array, "3"]:
        def without(n: Float[Array, "3"]) -> Float[Array, "3"]:
            return slope(n) - pole * pair.size[k] * jnp.sign(n @ pole)

        return least_on_circle(lambda n: _overlap(pair, n), pole, jnp.asarray(_UP), pair.radius, without)

    rims = jax.vmap(circle)(axes, jnp.arange(3))
    known = jnp.concatenate([axes, _UP[None], unit(cross)])
    candidates = jnp.concatenate([towards(known, d), unit(corners), rims])
    depth = jax.vmap(lambda n: _overlap(pair, n))(candidates)
    depth = depth.at[4:7].add(jnp.where(parallel, 1e3, 0.0)).at[15:18].add(jnp.where(parallel, 1e3, 0.0))
    best = jnp.argmin(depth)
    return candidates[best], best, depth[best]


def _single(pair: _Pair, n: Float[Array, "3"], kind: Array, depth: Float[Array, ""]) -> Float[Array, "3"]:
    """The middle between the deepest points of both."""
    across = n * jnp.array([1.0, 1.0, 0.0])
    side = unit(across) * pair.radius
    on_cylinder = side + pair.half * jnp.where(n[2] >= 0, 1.0, -1.0) * _UP
    signs = jnp.where(n @ pair.turn >= 0, 1.0, -1.0)
    on_box = pair.apart - pair.turn @ (pair.size * signs)
    k = jnp.clip(kind - 4, 0, 2)
    edge = pair.turn[:, k]
    middle = on_box + edge * pair.size[k] * signs[k]
    one, other = closest_on_lines(side, jnp.asarray(_UP), pair.half, middle, edge, pair.size[k])
    by_box = (kind == 3) | ((kind >= 7) & (kind < 15))
    by_lines = (kind >= 4) & (kind < 7)
    return jnp.where(
        by_lines, 0.5 * (one + other), jnp.where(by_box, on_box + n * depth / 2, on_cylinder - n * depth / 2)
    )


def _clip_segment(start: Array, way: Array, centre: Array, first: Array, second: Array, limit: Array):
    """Parameters at which a segment enters and leaves the prism over a rectangle, within 0 to 1."""
    along = jnp.stack([way @ first, way @ second])
    at = jnp.stack([(start - centre) @ first, (start - centre) @ second])
    speed = jnp.concatenate([along, -along])
    room = jnp.concatenate([limit - at, limit + at])
    still = jnp.abs(speed) < 1e-9
    crossing = room / jnp.where(still, 1.0, speed)
    enter = jnp.where(still, jnp.where(room < 0, 2.0, 0.0), jnp.where(speed < 0, crossing, 0.0)).max()
    leave = jnp.where(still, 1.0, jnp.where(speed > 0, crossing, 1.0)).min()
    return jnp.maximum(enter, 0.0), jnp.minimum(leave, 1.0)


def _side_on_face(pair: _Pair, n: Float[Array, "3"], normals: Float[Array, "3 3"]):
    """The cylinder's side line on a box face that it is parallel to: two points, and whether this is the case."""
    parallel = (jnp.abs(pair.turn[2]) < SQUARE) & (jnp.abs(n @ pair.turn) > 1e-6)
    k = jnp.argmax(parallel)
    normal = normals[k]
    i, j = (k + 1) % 3, (k + 2) % 3
    centre = pair.apart + normal * pair.size[k]
    side = unit(n * jnp.array([1.0, 1.0, 0.0])) * pair.radius
    start, way = side - pair.half * _UP, 2 * pair.half * _UP
    limit = jnp.stack([pair.size[i], pair.size[j]])
    enter, leave = _clip_segment(start, way, centre, pair.turn[:, i], pair.turn[:, j], limit)
    points = start + jnp.stack([enter, leave])[:, None] * way
    distance = (points - centre) @ normal
    valid = (enter <= leave) & (distance <= 0)
    return (
        jnp.where(valid, distance, FAR),
        points - 0.5 * distance[:, None] * normal,
        -normal,
        parallel.any() & valid.any(),
    )


def _cap_on_face(pair: _Pair, n: Float[Array, "3"], normals: Float[Array, "3 3"]):
    """The part of a box face over a cap that it is parallel to: four points, and whether this is the case."""
    up = jnp.where(n[2] >= 0, 1.0, -1.0)
    facing = jnp.where(jnp.abs(n @ pair.turn) > SQUARE, up * normals[:, 2], 1.0)
    k = jnp.argmin(facing)
    normal = normals[k]
    i, j = (k + 1) % 3, (k + 2) % 3
    centre = pair.apart + normal * pair.size[k]
    u, v = pair.turn[:, i] * pair.size[i], pair.turn[:, j] * pair.size[j]
    points, valid = _face_over_disc(centre, u, v, pair.radius)
    valid &= up * points[:, 2] <= pair.half
    chosen, kept = four_extremes(points, valid)
    points = points[chosen]
    foot = points.at[:, 2].set(up * pair.half)
    # As in C: the foot on the cap's plane, the other point along the face's normal from it.
    gap = (foot - points) @ normal
    position = foot - 0.5 * gap[:, None] * normal
    use = (facing[k] < -ALIGNED) & (jnp.abs(n[2]) > SQUARE) & valid.any()
    return jnp.where(kept, gap, FAR), position, -normal, use


_AROUND = np.arange(8) * (2 * np.pi / 8)
_QUADS = np.array(list(itertools.combinations(range(8), 4)))


def four_extremes(points: Float[Array, "many 3"], valid: Array) -> tuple[Array, Array]:
    """Four of the valid points that span the most area in x and y, each once; all where there are four or fewer.

    Chosen among the extremes in eight directions, which come in order around the hull.
    """
    worst = jnp.where(valid, 0.0, -1e6)
    directions = jnp.asarray(np.stack([np.cos(_AROUND), np.sin(_AROUND)]), points.dtype)
    extremes = jnp.argmax(points[:, :2] @ directions + worst[:, None], axis=0)
    a, b, c, d = (points[extremes[_QUADS[:, k]], :2] for k in range(4))
    area = jnp.abs((a - c)[:, 0] * (b - d)[:, 1] - (a - c)[:, 1] * (b - d)[:, 0])
    widest = extremes[jnp.asarray(_QUADS)[jnp.argmax(area)]]
    few = valid.sum() <= 4
    chosen = jnp.where(few, jnp.argsort(~valid, stable=True)[:4], widest)
    fresh = jnp.tril(chosen[:, None] == chosen[None, :], -1).sum(1) == 0
    return chosen, valid[chosen] & fresh


def _face_over_disc(centre: Array, u: Array, v: Array, radius: Array):
    """Corners of the parallelogram ``centre ± u ± v`` cut to MuJoCo's 16-gon around the z axis: points, which are."""
    turn = np.arange(16) * (2 * np.pi / 16)
    ring = jnp.asarray(np.stack([np.cos(turn), np.sin(turn)], -1), centre.dtype) * radius
    middle = turn + np.pi / 16
    outward = jnp.asarray(np.stack([np.cos(middle), np.sin(middle)], -1), centre.dtype)
    bound = radius * np.cos(np.pi / 16)
    su = np.array([1.0, -1.0, -1.0, 1.0], np.float32)[:, None]
    sv = np.array([1.0, 1.0, -1.0, -1.0], np.float32)[:, None]
    start = centre + su * u + sv * v
    way = jnp.roll(start, -1, axis=0) - start
    speed, room = way[:, :2] @ outward.T, bound - start[:, :2] @ outward.T
    still = jnp.abs(speed) < 1e-9
    crossing = room / jnp.where(still, 1.0, speed)
    enter = jnp.where(still, jnp.where(room < 0, 2.0, 0.0), jnp.where(speed < 0, crossing, 0.0)).max(-1)
    leave = jnp.where(still, 1.0, jnp.where(speed > 0, crossing, 1.0)).min(-1)
    enter, leave = jnp.maximum(enter, 0.0), jnp.minimum(leave, 1.0)
    inside = enter <= leave
    leaving = inside & (leave < 1) & (leave > enter)
    area = u[0] * v[1] - u[1] * v[0]
    area = jnp.where(jnp.abs(area) < 1e-12, 1e-12, area)
    offset = ring - centre[:2]
    on_u = (offset[:, 0] * v[1] - offset[:, 1] * v[0]) / area
    on_v = (offset[:, 1] * u[0] - offset[:, 0] * u[1]) / area
    covered = (jnp.abs(on_u) < 1) & (jnp.abs(on_v) < 1)
    corners = jnp.concatenate([ring, (centre[2] + on_u * u[2] + on_v * v[2])[:, None]], -1)
    points = jnp.concatenate([start + enter[:, None] * way, start + leave[:, None] * way, corners])
    return points, jnp.concatenate([inside, leaving, covered])


def cylinder_box(cylinder: Geom, box: Geom) -> Points:
    """Up to four points: the deepest overlap, or where faces or a face and the side line are parallel, their common part.

    MuJoCo finds the direction with an expanding polytope and several points by clipping (``mjc_Convex``, multiccd).
    """
    turn = cylinder[1].T @ box[1]
    pair = _Pair(cylinder[2][0], cylinder[2][1], box[2], turn, cylinder[1].T @ (box[0] - cylinder[0]))
    n, kind, depth = _direction(pair)
    normals = -jnp.where(n @ turn >= 0, 1.0, -1.0)[:, None] * turn.T
    distance = jnp.full(4, FAR).at[0].set(-depth)
    position = jnp.tile(_single(pair, n, kind, depth), (4, 1))
    normal = n
    d_side, p_side, n_side, on_side = _side_on_face(pair, n, normals)
    distance = jnp.where(on_side, jnp.full(4, FAR).at[:2].set(d_side), distance)
    position = jnp.where(on_side, position.at[:2].set(p_side), position)
    normal = jnp.where(on_side, n_side, normal)
    d_cap, p_cap, n_cap, on_cap = _cap_on_face(pair, n, normals)
    distance = jnp.where(on_cap, d_cap, distance)
    position = jnp.where(on_cap, p_cap, position)
    normal = jnp.where(on_cap, n_cap, normal)
    distance = jnp.where(depth > 0, distance, FAR)
    return distance, cylinder[0] + position @ cylinder[1].T, jnp.tile(cylinder[1] @ normal, (4, 1))
