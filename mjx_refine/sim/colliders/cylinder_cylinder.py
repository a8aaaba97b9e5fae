"""Contacts of two cylinders as C MuJoCo's convex collider has them (MJX's descends a distance field and misses some)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.sim.colliders.contact import Geom, Points
from mjx_refine.sim.colliders.cylinder_box import FAR, four_extremes
from mjx_refine.sim.colliders.directions import closest_on_lines, least_on_circle, least_smooth, towards, unit
from mjx_refine.sim.parallel import ALIGNED, SQUARE

_UP = np.array([0.0, 0.0, 1.0], np.float32)
_RING = np.stack([np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8)], -1)


class _Pair(NamedTuple):
    """In the first cylinder's frame: both radii and half heights, the second's axes (columns) and centre."""

    r1: Float[Array, ""]
    h1: Float[Array, ""]
    r2: Float[Array, ""]
    h2: Float[Array, ""]
    turn: Float[Array, "3 3"]
    apart: Float[Array, "3"]

    @property
    def axis(self) -> Float[Array, "3"]:
        """The second cylinder's."""
        return self.turn[:, 2]


def _across(n: Array, axis: Array) -> Array:
    return n - (n @ axis) * axis


def _overlap(pair: _Pair, n: Float[Array, "3"]) -> Float[Array, ""]:
    along = n @ pair.axis
    first = pair.r1 * jnp.sqrt(jnp.maximum(1 - n[2] ** 2, 1e-12)) + pair.h1 * jnp.abs(n[2])
    second = pair.r2 * jnp.sqrt(jnp.maximum(1 - along**2, 1e-12)) + pair.h2 * jnp.abs(along)
    return first + second - pair.apart @ n


def _direction(pair: _Pair) -> tuple[Float[Array, "3"], Array, Float[Array, ""]]:
    """Direction of least overlap, its kind (0, 1 caps, 2 crossing sides, 3, 4 side and rim, 5 rims), the depth."""
    d, up = pair.apart, jnp.asarray(_UP)
    cross = jnp.cross(up, pair.axis)
    parallel = cross @ cross < 1e-8

    def f(n: Array) -> Array:
        return _overlap(pair, n)

    def second_slope(n: Array) -> Array:
        return pair.h2 * jnp.sign(n @ pair.axis) * pair.axis - d

    def first_slope(n: Array) -> Array:
        return pair.h1 * jnp.sign(n[2]) * up - d

    known = towards(jnp.stack([up, pair.axis, unit(cross)]), d)
    side = least_on_circle(f, up, pair.axis, pair.r2, second_slope)
    side = jnp.where(parallel, unit(d * (1 - up)), side)
    other = least_on_circle(f, pair.axis, up, pair.r1, first_slope)
    rims = least_smooth(f, d, pair.axis, ((pair.r1, pair.h1), (pair.r2, pair.h2)))
    candidates = jnp.concatenate([known, jnp.stack([side, other, rims])])
    depth = jax.vmap(f)(candidates)
    depth = depth + jnp.where(parallel, jnp.array([0.0, 0.0, 1e3, 0.0, 1e3, 0.0]), 0.0)
    best = jnp.argmin(depth)
    return candidates[best], best, depth[best]


def _single(pair: _Pair, n: Float[Array, "3"], kind: Array, depth: Float[Array, ""]) -> Float[Array, "3"]:
    """The middle between the deepest points of both."""
    side = unit(_across(n, jnp.asarray(_UP))) * pair.r1
    on_first = side + pair.h1 * jnp.where(n[2] >= 0, 1.0, -1.0) * _UP
    line = pair.apart - unit(_across(n, pair.axis)) * pair.r2
    on_second = line - pair.h2 * jnp.where(n @ pair.axis >= 0, 1.0, -1.0) * pair.axis
    one, other = closest_on_lines(side, jnp.asarray(_UP), pair.h1, line, pair.axis, pair.h2)
    by_lines = (kind == 2) | ((kind == 3) & (jnp.abs(n @ pair.axis) < 1e-3))
    by_second = (kind == 0) | (kind == 3)
    by_one = jnp.where(by_second, on_second + n * depth / 2, on_first - n * depth / 2)
    return jnp.where(by_lines, 0.5 * (one + other), by_one)


def _line_on_cap(start: Array, way: Array, cap: Array, outward: Array, radius: Array):
    """Distances, positions of a side line's two ends where it is cut to a cap, and whether any is below the cap."""
    flat, at = _across(way, outward), _across(start - cap, outward)
    a, b, c = flat @ flat, flat @ at, at @ at - radius**2
    root = jnp.sqrt(jnp.maximum(b * b - a * c, 1e-12))
    a = jnp.maximum(a, 1e-9)
    enter, leave = jnp.maximum((-b - root) / a, 0.0), jnp.minimum((-b + root) / a, 1.0)
    points = start + jnp.stack([enter, leave])[:, None] * way
    distance = (points - cap) @ outward
    valid = (enter <= leave) & (distance <= 0) & (b * b - a * c > 0)
    return jnp.where(valid, distance, FAR), points - 0.5 * distance[:, None] * outward, valid.any()


def _side_on_cap(pair: _Pair, n: Float[Array, "3"]):
    """A side line on the other cylinder's cap where they are parallel: two points, the normal, whether it is so."""
    up = jnp.asarray(_UP)
    crossed = jnp.abs(pair.axis[2]) < SQUARE
    along = n @ pair.axis
    cap_of_second = jnp.abs(along) > 1e-3
    out2 = -jnp.where(along >= 0, 1.0, -1.0) * pair.axis
    start1 = unit(_across(n, up)) * pair.r1 - pair.h1 * up
    d2, p2, any2 = _line_on_cap(start1, 2 * pair.h1 * up, pair.apart + pair.h2 * out2, out2, pair.r2)
    out1 = jnp.where(n[2] >= 0, 1.0, -1.0) * up
    start2 = pair.apart - unit(_across(n, pair.axis)) * pair.r2 - pair.h2 * pair.axis
    d1, p1, any1 = _line_on_cap(start2, 2 * pair.h2 * pair.axis, pair.h1 * out1, out1, pair.r1)
    use = crossed & jnp.where(cap_of_second, any2, any1 & (jnp.abs(n[2]) > 1e-3))
    distance = jnp.where(cap_of_second, d2, d1)
    return distance, jnp.where(cap_of_second, p2, p1), jnp.where(cap_of_second, -out2, out1), use


def _cap_on_cap(pair: _Pair, n: Float[Array, "3"]):
    """The common part of two caps that are parallel: four points, the normal, whether it is so."""
    along = n @ pair.axis
    up = jnp.where(n[2] >= 0, 1.0, -1.0)
    out2 = -jnp.where(along >= 0, 1.0, -1.0) * pair.axis
    facing = up * out2[2]
    cap = pair.apart + pair.h2 * out2
    # Corners of the common part: of each 16-gon those inside the other, and the rims' crossings.
    ring = jnp.asarray(_RING, cap.dtype)
    second = cap + pair.r2 * ring @ pair.turn[:, :2].T
    first = pair.r1 * ring
    offset, gap = cap[:2], jnp.sqrt(jnp.maximum(cap[:2] @ cap[:2], 1e-12))
    toward = offset / gap
    along_x = (gap**2 + pair.r1**2 - pair.r2**2) / (2 * gap)
    square = pair.r1**2 - along_x**2
    height = jnp.sqrt(jnp.maximum(square, 1e-12))
    sideways = jnp.stack([-toward[1], toward[0]])
    crossings = along_x * toward + jnp.array([[1.0], [-1.0]]) * height * sideways
    flat = jnp.concatenate([first, crossings])
    slope = jnp.where(jnp.abs(out2[2]) > 0.5, out2[2], 1.0)
    lifted = cap[2] - ((flat - offset) @ out2[:2]) / slope
    points = jnp.concatenate([second, jnp.concatenate([flat, lifted[:, None]], -1)])
    inside1 = (second[:, :2] ** 2).sum(-1) <= pair.r1**2
    inside2 = ((first - offset) ** 2).sum(-1) <= pair.r2**2
    valid = jnp.concatenate([inside1, inside2, jnp.tile(square > 0, 2)]) & (up * points[:, 2] <= pair.h1)
    chosen, kept = four_extremes(points, valid)
    points = points[chosen]
    foot = points.at[:, 2].set(up * pair.h1)
    distance = (foot - points) @ out2
    use = (facing < -ALIGNED) & (jnp.abs(n[2]) > SQUARE) & (jnp.abs(along) > SQUARE) & valid.any()
    return jnp.where(kept, distance, FAR), foot - 0.5 * distance[:, None] * out2, -out2, use


def cylinder_cylinder(first: Geom, second: Geom) -> Points:
    """Up to four points, as of a cylinder and a box."""
    turn = first[1].T @ second[1]
    apart = first[1].T @ (second[0] - first[0])
    pair = _Pair(first[2][0], first[2][1], second[2][0], second[2][1], turn, apart)
    n, kind, depth = _direction(pair)
    distance = jnp.full(4, FAR).at[0].set(-depth)
    position = jnp.tile(_single(pair, n, kind, depth), (4, 1))
    d_side, p_side, n_side, on_side = _side_on_cap(pair, n)
    distance = jnp.where(on_side, jnp.full(4, FAR).at[:2].set(d_side), distance)
    position = jnp.where(on_side, position.at[:2].set(p_side), position)
    normal = jnp.where(on_side, n_side, n)
    d_cap, p_cap, n_cap, on_cap = _cap_on_cap(pair, n)
    distance = jnp.where(on_cap, d_cap, distance)
    position = jnp.where(on_cap, p_cap, position)
    normal = jnp.where(on_cap, n_cap, normal)
    distance = jnp.where(depth > 0, distance, FAR)
    return distance, first[0] + position @ first[1].T, jnp.tile(first[1] @ normal, (4, 1))
