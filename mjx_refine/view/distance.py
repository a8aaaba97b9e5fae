"""Distances that can be differentiated: in the picture to outlines [px], along rays to surfaces."""

from __future__ import annotations

import functools

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_refine.scene import Shape
from mjx_refine.view.outline import CORNERS, Arrays, Placed, corners, directions, larger, place, smaller, support_of
from mjx_refine.view.rays import safe, slabs

_Vector = tuple[Array, ...]

EDGES = tuple(
    (i, j) for i in range(8) for j in range(i) if sum(a != b for a, b in zip(CORNERS[i], CORNERS[j], strict=True)) == 1
)
"""The corners at both ends of a box's edges."""


def _unit(x: Array, y: Array) -> Array:
    """Unit vectors; one of no length becomes a constant."""
    square = x * x + y * y
    length = jnp.sqrt(larger(square, 1e-20))
    still = square <= 1e-20
    return jnp.stack([jnp.where(still, 1.0, x / length), jnp.where(still, 0.0, y / length)], -1)


def _both(normals: Array) -> Array:
    return jnp.concatenate([normals, -normals], -2)


def rulings(placed: Placed, n: int) -> tuple[Array, Array, Array]:
    """Where the view touches cylinder ``n``'s side.

    Returns:
      (u, v, cosine): in the object's frame, unit vectors towards the camera and across, (batch, frames, 2), and the
      cosine of the angle between u and both touched rulings, (batch, frames); at most 1 - 1e-6.
    """
    axes, centre = placed.axes[:, :, n], placed.shown[:, :, n]
    camera = -(axes[..., :2] * centre[..., :, None]).sum(-2)
    u = _unit(camera[..., 0], camera[..., 1])
    far = jnp.sqrt((camera**2).sum(-1) + 1e-12)
    cosine = smaller(placed.size[:, :, n, 0] / far, 1 - 1e-6)
    return u, jnp.stack([-u[..., 1], u[..., 0]], -1), cosine


def _rim_normals(placed: Placed, n: int, count: int) -> Array:
    """Normals of both rims' pictures at points evenly spaced on the rims: a thin ellipse has most at its ends."""
    axes, centre, size = placed.axes[:, :, n], placed.shown[:, :, n], placed.size[:, :, n]
    turn = jnp.asarray(directions(count), axes.dtype)
    e1, e2 = axes[..., None, :, 0], axes[..., None, :, 1]
    spoke, tangent = turn[:, :1] * e1 + turn[:, 1:] * e2, turn[:, :1] * e2 - turn[:, 1:] * e1
    result = []
    for sign in (1, -1):
        middle = centre + sign * size[..., 1, None] * axes[..., 2]
        point = middle[..., None, :] + size[..., None, :1] * spoke
        x, y = (tangent[..., i] * point[..., 2] - point[..., i] * tangent[..., 2] for i in range(2))
        normal = _unit(-y, x)
        # Outwards is where the point lies beside the rim's middle.
        beside = [point[..., i] * middle[..., None, 2] - middle[..., None, i] * point[..., 2] for i in range(2)]
        outward = normal[..., 0] * beside[0] + normal[..., 1] * beside[1]
        result.append(jnp.where(outward[..., None] < 0, -normal, normal))
    return jnp.concatenate(result, -2)


def normals_of(shape: Shape, placed: Placed, n: int, count: int) -> Float[Array, "batch frames directions 2"]:
    """Outline normals that describe object ``n``'s silhouette: its straight edges exactly, its arcs closely.

    ``count`` evenly spaced ones, and for a box both normals of its twelve edges, for a cylinder half as many for each rim
    and both normals of the two rulings that the view touches.
    """
    even = jnp.asarray(directions(count), placed.centre.dtype)
    even = jnp.broadcast_to(even, (*placed.centre.shape[:2], count, 2))
    if shape == "sphere":
        return even
    if shape == "box":
        points = corners(placed, n)
        start, end = ([e[k] for e in EDGES] for k in (0, 1))
        edge = points[:, :, jnp.asarray(end)] - points[:, :, jnp.asarray(start)]
        return jnp.concatenate([even, _both(_unit(-edge[..., 1], edge[..., 0]))], -2)
    u, v, cosine = rulings(placed, n)
    sine = jnp.sqrt(1.0 - cosine * cosine)
    sides = []
    for sign in (1, -1):
        radial = cosine[..., None] * u + sign * sine[..., None] * v
        # The plane that touches the side along a ruling goes through the camera: its normal is the picture's too.
        x, y = ((placed.axes[:, :, n, i, :2] * radial).sum(-1) for i in range(2))
        sides.append(_unit(x, y))
    return jnp.concatenate([even, _rim_normals(placed, n, -(-count // 2)), _both(jnp.stack(sides, -2))], -2)


def distance_of(
    shape: Shape, placed: Placed, n: int, pixels: Float[Array, "pixels 2"], count: int
) -> Float[Array, "batch frames pixels"]:
    """Signed distance [px] of ``pixels``, from the principal point, to object ``n``'s outline."""
    normals = normals_of(shape, placed, n, count)
    reach = support_of(shape, placed, n, normals)
    x, y = pixels[:, 0, None], pixels[:, 1, None]
    along = x * normals[..., None, :, 0] + y * normals[..., None, :, 1]
    # Which normal has no derivative; what it gives has: nothing as large as ``along`` is kept for reverse mode.
    chosen = (along - reach[..., None, :]).argmax(-1)
    nx, ny, h = (jnp.take_along_axis(a, chosen, -1) for a in (normals[..., 0], normals[..., 1], reach))
    return pixels[:, 0] * nx + pixels[:, 1] * ny - h


def signed_distance(
    shapes: tuple[Shape, ...],
    arrays: Arrays,
    pixels: Float[Array, "pixels 2"],
    image: tuple[int, int],
    count: int = 64,
) -> Float[Array, "batch frames objects pixels"]:
    """Distance [px] of ``pixels`` to each object's outline, negative inside; nothing hides anything.

    The largest n . x - h(n) over outline normals n (``normals_of``), h the support function: exact in front of and inside
    straight edges; too small by at most the part 1 - cos(pi / count) of the distance beside corners, and by that of the
    radius of curvature beside arcs.

    Args:
      shapes: of the objects.
      arrays: poses, sizes and cameras.
      pixels: (x, y) [px], pixel (r, c) at (c + 0.5, r + 0.5).
      image: (width, height) [px].
      count: normals of an arc.
    """
    placed = place(shapes, arrays, image)
    middle = jnp.asarray([0.5 * image[0], 0.5 * image[1]], placed.centre.dtype)
    shifted = pixels - middle
    return jnp.stack([distance_of(shape, placed, n, shifted, count) for n, shape in enumerate(shapes)], 2)


# Along rays -------------------------------------------------------------------------------------------------------------

TANGENT = 1e-6
"""Square of the half chord of a ray that only touches, over the radius squared: its square root has a derivative."""


def _sphere(o: _Vector, d: _Vector, size: _Vector) -> tuple[Array, Array]:
    dd = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    along = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / dd
    px, py, pz = (oi + along * di for oi, di in zip(o, d, strict=True))
    square = size[0] * size[0]
    gap = square - (px * px + py * py + pz * pz)
    return along - jnp.sqrt(larger(gap, TANGENT * square + 1e-12) / dd), gap > 0.0


def _box(o: _Vector, d: _Vector, size: _Vector) -> tuple[Array, Array]:
    nears, fars = slabs(o, d, size)
    near, far = functools.reduce(larger, nears), functools.reduce(smaller, fars)
    return near, near < far


def _cylinder(o: _Vector, d: _Vector, size: _Vector) -> tuple[Array, Array]:
    square = size[0] * size[0]
    across = safe(d[0] * d[0] + d[1] * d[1])
    along = -(o[0] * d[0] + o[1] * d[1]) / across
    px, py = o[0] + along * d[0], o[1] + along * d[1]
    gap = square - (px * px + py * py)
    reach = jnp.sqrt(larger(gap, TANGENT * square + 1e-12) / across)
    inverse = 1.0 / safe(d[2])
    middle, width = -o[2] * inverse, size[1] * jnp.abs(inverse)
    near = larger(along - reach, middle - width)
    return near, (gap > 0.0) & (near < smaller(along + reach, middle + width))


_HIT = {"sphere": _sphere, "box": _box, "cylinder": _cylinder}


def surface(
    shape: Shape, o: _Vector, d: _Vector, size: _Vector
) -> tuple[Float[Array, "*grid"], Float[Array, "*grid"], Bool[Array, "*grid"]]:
    """Where rays o + t d meet an object in its own frame, as ``rays.HIT`` has it, with derivatives that are finite.

    Returns:
      (t, beside, hit): the ray parameter of the nearest hit, continued beside the outline no farther than the object's
      bounding sphere reaches; that of the ray's point nearest to the centre; whether the ray hits ahead.
    """
    near, hit = _HIT[shape](o, d, size)
    dd = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    beside = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / dd
    bound = jnp.sqrt((size[0] * size[0] + size[1] * size[1] + size[2] * size[2] + 1e-12) / dd)
    return smaller(larger(near, beside - bound), beside + bound), beside, hit & (near > 0.0)
