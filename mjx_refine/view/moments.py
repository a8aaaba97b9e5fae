"""Areas, centroids and second moments of silhouettes, by Green's theorem on what the camera sees of each surface.

A convex body's silhouette is the sum of the pictures of its visible faces: no face hides another. Each is integrated in
closed form or, on arcs, by Gauss's rule; a face that turns away has no area left, so that sums stay smooth.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from mjx_refine.scene import Shape
from mjx_refine.view.distance import rulings
from mjx_refine.view.outline import NEAR, Arrays, Placed, corners, larger, place

# Corners of faces, clockwise from outside: in the picture, where y points down, a visible face then has positive area.
FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))

NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)

BESIDE = 2
"""How near to the border or to another mask an outline may be cut by it [px]."""

LEAST_AREA = 1e-6
"""Area [px^2] below which a silhouette has no centroid of its own."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Moments:
    """Of silhouettes; leading axes are (batch, frames, objects), or (frames, objects) of an observation.

    Attributes:
      area: [px^2].
      centroid: (x, y) [px].
      second: central, over the area: the covariance of the silhouette's points [px^2].
    """

    area: Float[Array, "*grid"]
    centroid: Float[Array, "*grid 2"]
    second: Float[Array, "*grid 2 2"]


def _power(x: Array, y: Array, cross: Array) -> Array:
    """What a point of a boundary adds to the integrals of 1, x, y, x^2, x y, y^2 where it moves by ``cross`` = x dy - y dx.

    Green's theorem for a homogeneous g of degree k: the integral of g is that of g (x dy - y dx) / (k + 2).
    """
    terms = [jnp.ones_like(x) / 2, x / 3, y / 3, x * x / 4, x * y / 4, y * y / 4]
    return jnp.stack(terms, -1) * cross[..., None]


def _segments(start: Array, end: Array) -> Array:
    """Ditto of straight segments, (..., 2) each, exactly."""
    x0, y0, x1, y1 = start[..., 0], start[..., 1], end[..., 0], end[..., 1]
    cross = x0 * y1 - y0 * x1
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    middle = _power(x, y, cross)
    # Simpson's rule is exact for quadratics.
    return (_power(x0, y0, cross) + 4 * middle + _power(x1, y1, cross)) / 6


def _of_ellipse(area: Array, centre: Array, second: tuple[Array, Array, Array]) -> Array:
    """Integrals over an ellipse; ``second`` is its covariance as (xx, xy, yy)."""
    x, y = centre[..., 0], centre[..., 1]
    terms = [jnp.ones_like(x), x, y, second[0] + x * x, second[1] + x * y, second[2] + y * y]
    return jnp.stack(terms, -1) * area[..., None]


def _sphere(placed: Placed, n: int, reference: Array) -> Array:
    """The ellipse whose support function is n . c + sqrt(n . S n), see ``outline._sphere``; its covariance is S / 4."""
    centre, radius = placed.shown[:, :, n], placed.size[:, :, n, 0]
    focal = placed.focal[..., 0]
    x, y, depth = (centre[..., i] for i in range(3))
    leading = (depth - radius) * (depth + radius)
    scale = focal * radius / leading
    area = jnp.pi * scale * scale * jnp.sqrt(leading * (x * x + y * y + leading))
    # c - f m / m_d, without cancellation.
    shift = (focal * radius * radius / (leading * depth))[..., None] * centre[..., :2]
    middle = shift + focal[..., None] * centre[..., :2] / depth[..., None] - reference
    s = 0.25 * scale * scale
    return _of_ellipse(area, middle, (s * (x * x + leading), s * x * y, s * (y * y + leading)))


def _cap(placed: Placed, n: int, sign: int, reference: Array) -> Array:
    """The picture of a cylinder's end, nothing where it faces away."""
    axis = sign * placed.axes[:, :, n, :, 2]
    radius, half = placed.size[:, :, n, 0], placed.size[:, :, n, 1]
    centre = placed.shown[:, :, n] + half[..., None] * axis
    focal, square = placed.focal[..., 0], radius * radius
    mx, my, md = (centre[..., i] for i in range(3))
    ax, ay, ad = (axis[..., i] for i in range(3))
    leading = md * md - square * (ax * ax + ay * ay)
    facing = -(ax * mx + ay * my + ad * md)
    area = jnp.pi * square * focal * focal * larger(facing, 0.0) / (leading * jnp.sqrt(leading))
    middle = [focal * (m * md + square * a * ad) / leading for m, a in ((mx, ax), (my, ay))]
    # The discriminant of ``outline._rim`` as a quadratic form in the direction across n.
    cx, cy = my * ad - md * ay, md * ax - mx * ad
    s = 0.25 * square * focal * focal / (leading * leading)
    xx = my * my + md * md - cx * cx - square * ax * ax
    yy = mx * mx + md * md - cy * cy - square * ay * ay
    xy = -mx * my - cx * cy - square * ax * ay
    return _of_ellipse(area, jnp.stack(middle, -1) - reference, (s * yy, -s * xy, s * xx))


def _side(placed: Placed, n: int, reference: Array) -> Array:
    """The picture of the part of a cylinder's side that the camera sees: two arcs and the rulings between them."""
    u, v, cosine = rulings(placed, n)
    axes, centre, size = placed.axes[:, :, n], placed.shown[:, :, n], placed.size[:, :, n]
    angle = jnp.arctan2(jnp.sqrt(1.0 - cosine * cosine), cosine)
    turn = angle[..., None] * jnp.asarray(np.concatenate([NODES, [-1.0, 1.0]]), angle.dtype)
    c, s = jnp.cos(turn)[..., None], jnp.sin(turn)[..., None]
    e1 = (axes[..., :2] * u[..., None, :]).sum(-1)[..., None, :]
    e2 = (axes[..., :2] * v[..., None, :]).sum(-1)[..., None, :]
    radius, focal = size[..., None, :1], placed.focal
    spoke, tangent = radius * (c * e1 + s * e2), radius * (c * e2 - s * e1)
    weights = angle[..., None] * jnp.asarray(WEIGHTS, angle.dtype)
    total, ends = [], {}
    for sign in (1, -1):
        point = (centre + sign * size[..., 1, None] * axes[..., 2])[..., None, :] + spoke
        depth = larger(point[..., 2], 0.25 * NEAR)
        raw = [focal * point[..., i] / depth for i in range(2)]
        x, y = (raw[i] - reference[..., None, i] for i in range(2))
        dx, dy = ((focal * tangent[..., i] - raw[i] * tangent[..., 2]) / depth for i in range(2))
        arc = _power(x[..., :-2], y[..., :-2], (x * dy - y * dx)[..., :-2] * weights)
        total.append(sign * arc.sum(-2))
        ends[sign] = jnp.stack([x[..., -2:], y[..., -2:]], -1)
    total.append(
        _segments(ends[-1][..., 0, :], ends[1][..., 0, :]) + _segments(ends[1][..., 1, :], ends[-1][..., 1, :])
    )
    # Above the end of the cylinder, the camera sees nothing of its side.
    return jnp.where((cosine < 1 - 1e-6)[..., None], sum(total), 0.0)


def _box(placed: Placed, n: int, reference: Array) -> Array:
    points = corners(placed, n) - reference[..., None, :]
    faces = points[:, :, jnp.asarray(FACES)]
    sums = _segments(faces, jnp.roll(faces, -1, axis=-2)).sum(-2)
    return jnp.where(sums[..., :1] > 0, sums, 0.0).sum(-2)


def moments_of(shapes: tuple[Shape, ...], placed: Placed, image: tuple[int, int]) -> Moments:
    """Moments of every object, in pixels of ``image``."""
    middle = jnp.asarray([0.5 * image[0], 0.5 * image[1]], placed.centre.dtype)
    result = []
    for n, shape in enumerate(shapes):
        # From the picture of the object's centre: integrals over a large picture would cancel.
        reference = placed.focal * placed.shown[:, :, n, :2] / placed.shown[:, :, n, 2:]
        if shape == "sphere":
            sums = _sphere(placed, n, reference)
        elif shape == "box":
            sums = _box(placed, n, reference)
        else:
            sums = _side(placed, n, reference) + _cap(placed, n, 1, reference) + _cap(placed, n, -1, reference)
        mean = sums[..., 1:] / larger(sums[..., :1], LEAST_AREA)
        x, y = mean[..., 0], mean[..., 1]
        xx, xy, yy = mean[..., 2] - x * x, mean[..., 3] - x * y, mean[..., 4] - y * y
        second = jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], -2)
        result.append(Moments(sums[..., 0], mean[..., :2] + reference + middle, second))
    return jax.tree.map(lambda *x: jnp.stack(x, 2), *result)


def moments(shapes: tuple[Shape, ...], arrays: Arrays, image: tuple[int, int]) -> Moments:
    """Area, centroid and second moments of each object's silhouette as if nothing hid it, (batch, frames, objects).

    Exact, whatever lies outside of the picture too; smooth but where a face turns edge on.

    Args:
      shapes: of the objects.
      arrays: poses, sizes and cameras.
      image: (width, height) [px].
    """
    return moments_of(shapes, place(shapes, arrays, image), image)


def mask_moments(
    masks: Int[np.ndarray, "frames height width"],
    ids: tuple[int, ...],
    least: int = 12,
    near: int = BESIDE,
    before: Bool[np.ndarray, "frames ids"] | None = None,
) -> Moments:
    """Moments of observed masks, (frames, ids), float64; NaN where they cannot be the whole silhouette's.

    That is where the mask has fewer than ``least`` pixels, or comes within ``near`` of the border or of another mask which it
    is not known to be ``before``.
    """
    shape = (len(masks), len(ids))
    area, centroid, second = np.full(shape, np.nan), np.full((*shape, 2), np.nan), np.full((*shape, 2, 2), np.nan)
    for t, frame in enumerate(masks):
        for j, i in enumerate(ids):
            rows, columns = np.nonzero(frame == i)
            if len(rows) < least or min(rows.min(), columns.min()) < near:
                continue
            if rows.max() >= frame.shape[0] - near or columns.max() >= frame.shape[1] - near:
                continue
            top, left = max(rows.min() - near, 0), max(columns.min() - near, 0)
            part = frame[top : rows.max() + near + 1, left : columns.max() + near + 1]
            around = ndimage.maximum_filter(part == i, size=2 * near + 1)
            if (before is None or not before[t, j]) and (around & (part != i) & (part != 0)).any():
                continue
            points = np.stack([columns + 0.5, rows + 0.5], -1)
            area[t, j], centroid[t, j] = len(points), points.mean(0)
            second[t, j] = np.cov(points.T, bias=True)
    return Moments(area, centroid, second)  # type: ignore[arg-type]


def whole_masks(
    masks: Int[np.ndarray, "frames height width"],
    ids: tuple[int, ...],
    near: int = BESIDE,
    before: Bool[np.ndarray, "frames ids"] | None = None,
) -> Float[np.ndarray, "frames ids 3"]:
    """Centroid and equivalent radius, that of a disc as large, of masks that are seen whole [px]; NaN elsewhere."""
    found = mask_moments(masks, ids, near=near, before=before)
    return np.concatenate([found.centroid, np.sqrt(found.area / np.pi)[..., None]], -1)


def whole_function(
    shapes: tuple[Shape, ...], arrays: Arrays, image: tuple[int, int]
) -> Float[Array, "batch frames objects 3"]:
    """Centroid and equivalent radius of each object's silhouette as if nothing hid it [px]; pure."""
    found = moments(shapes, arrays, image)
    radius = jnp.sqrt(jnp.maximum(found.area, 0.0) / jnp.pi)
    return jnp.concatenate([found.centroid, radius[..., None]], -1)
