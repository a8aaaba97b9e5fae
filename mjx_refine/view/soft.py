"""Views that can be differentiated: soft masks, and residuals that pull at any distance.

Pure functions of arrays (``outline.Arrays``), in the arrays' own precision; derivatives are finite everywhere, also where
an object is hidden, behind the camera, outside of the view, not moving or of no size.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.scene import Shape
from mjx_refine.view.distance import distance_of, surface
from mjx_refine.view.moments import LEAST_AREA, Moments, moments_of
from mjx_refine.view.outline import NEAR, Arrays, Placed, camera_axes, directions, larger, place, support_of
from mjx_refine.view.points import point_flow_function

PIXEL_VARIANCE = 1 / 12
"""Variance of a square pixel's points [px^2]: what the moments of any mask have at least."""


# Soft masks -------------------------------------------------------------------------------------------------------------


def _inverse_depths(shapes: tuple[Shape, ...], placed: Placed, u: Array, v: Array) -> tuple[Array, Array]:
    """1 / depth [1/m] of each object's surface on rays (u, v, 1), and whether each is hit, (batch, frames, objects, pixels).

    Beside an outline the surface goes on about as far away as at the outline.
    """
    inverse, hits = [], []
    for n, shape in enumerate(shapes):
        axes = placed.axes[:, :, n, :, :, None]
        centre = placed.centre[:, :, n, :, None]
        d = tuple(axes[:, :, 0, j] * u + axes[:, :, 1, j] * v + axes[:, :, 2, j] for j in range(3))
        o = tuple(-(axes[:, :, :, j] * centre).sum(2) for j in range(3))
        size = tuple(jnp.broadcast_to(placed.size[:, :, n, i, None], d[0].shape) for i in range(3))
        t, _, hit = surface(shape, o, d, size)
        inverse.append(1.0 / larger(t, 0.25 * NEAR))
        hits.append(hit)
    return jnp.stack(inverse, 2), jnp.stack(hits, 2)


def soft_masks(
    shapes: tuple[Shape, ...],
    arrays: Arrays,
    pixels: Float[Array, "pixels 2"],
    image: tuple[int, int],
    width: float | Float[Array, ""],
    count: int = 64,
) -> Float[Array, "batch frames layers pixels"]:
    """How much of each pixel the background (layer 0) and each object k (layer k + 1) take; every pixel's sum is 1.

    An object covers sigmoid(-distance / ``width``) of a pixel. It hides what is farther along the pixel's ray: layers are
    composited pair by pair, and of two at depths that differ by the part r of their mean, the nearer is in front with
    sigmoid(r focal / ``width``). The floor hides what is below it. As ``width`` goes to 0, masks become those of
    ``picture.draw``. An object that reaches the camera's plane has no bounded outline: it is drawn hard there.

    Args:
      shapes: of the objects.
      arrays: poses, sizes and cameras.
      pixels: (x, y) [px], pixel (r, c) at (c + 0.5, r + 0.5).
      image: (width, height) [px].
      width: softness [px], > 0; a tenth is hard.
      count: normals of an arc, see ``distance.signed_distance``.
    """
    placed = place(shapes, arrays, image)
    shifted = pixels - jnp.asarray([0.5 * image[0], 0.5 * image[1]], placed.centre.dtype)
    distance = jnp.stack([distance_of(shape, placed, n, shifted, count) for n, shape in enumerate(shapes)], 2)
    u, v = shifted[:, 0] / placed.focal, shifted[:, 1] / placed.focal
    inverse, hit = _inverse_depths(shapes, placed, u, v)
    bounded = (placed.nearest > NEAR)[..., None]
    cover = jnp.where(bounded, jax.nn.sigmoid(-distance / width), hit.astype(distance.dtype))

    sharpness = placed.focal / width

    def in_front(a: Array, b: Array) -> Array:
        # Depth differences as wide as ``width`` is across the view; twice over the sum is over the mean.
        return jax.nn.sigmoid(2.0 * sharpness * (a - b) / (a + b))

    down = camera_axes(arrays[3])[:, 2]
    height = arrays[2][:, 2, None, None]
    falling = larger(-(down[:, 0, None, None] * u + down[:, 1, None, None] * v + down[:, 2, None, None]), 0.0)
    floor = jnp.where(height > 0, falling / larger(height, 1e-6), 0.0)
    objects = range(len(shapes))
    cover = jnp.stack([cover[:, :, k] * in_front(inverse[:, :, k], floor) for k in objects], 2)

    layers = [jnp.prod(1.0 - cover, 2)]
    for k in objects:
        share = cover[:, :, k]
        for j in objects:
            if j != k:
                share = share * (1.0 - cover[:, :, j] * in_front(inverse[:, :, j], inverse[:, :, k]))
        layers.append(share)
    stacked = jnp.stack(layers, 2)
    # Two layers add up to 1 by themselves, three or more only where their order is clear.
    return stacked / stacked.sum(2, keepdims=True)


# Residuals --------------------------------------------------------------------------------------------------------------


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Features:
    """What was seen of each object; NaN where it is not known.

    Attributes:
      reach: how far its mask reaches in evenly spaced directions [px], see ``outline.directions``.
      moments: of its mask (frames, objects), see ``moments.mask_moments``.
      pixels: where its flow was seen, (x, y) [px]; finite everywhere.
      flow: its flow there (x right, y down) [px/frame].
    """

    reach: Float[Array | np.ndarray, "frames objects directions"]
    moments: Moments
    pixels: Float[Array | np.ndarray, "frames objects points 2"]
    flow: Float[Array | np.ndarray, "frames objects points 2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Residuals:
    """Simulated minus seen [px], 0 where nothing was seen; leading axes are (batch, frames, objects).

    Attributes:
      reach: of outlines.
      radius: of the circle of the silhouette's area.
      centroid: (x, y).
      spread: lower Cholesky factor of the second moments: l11, l21, l22.
      flow: at the points seen.
    """

    reach: Float[Array, "batch frames objects directions"]
    radius: Float[Array, "batch frames objects"]
    centroid: Float[Array, "batch frames objects 2"]
    spread: Float[Array, "batch frames objects 3"]
    flow: Float[Array, "batch frames objects points 2"]

    def flat(self) -> Float[Array, "batch residuals"]:
        """All of a candidate's in one vector: reach, radius, centroid, spread, flow."""
        parts = (self.reach, self.radius, self.centroid, self.spread, self.flow)
        return jnp.concatenate([part.reshape(len(part), -1) for part in parts], -1)


def _radius(area: Array) -> Array:
    return jnp.sqrt(larger(area, LEAST_AREA) / jnp.pi)


def _spread(second: Array) -> Array:
    """Cholesky factor with a pixel's own variance added, which keeps it regular for slivers."""
    xx = larger(second[..., 0, 0], 0.0) + PIXEL_VARIANCE
    first = jnp.sqrt(xx)
    off = second[..., 1, 0] / first
    rest = second[..., 1, 1] - off * off
    return jnp.stack([first, off, jnp.sqrt(larger(rest, 0.0) + PIXEL_VARIANCE)], -1)


def _difference(simulated: Array, seen: Array | np.ndarray) -> Array:
    known = jnp.isfinite(seen)
    return jnp.where(known, simulated - jnp.where(known, seen, 0.0), 0.0)


def residuals(shapes: tuple[Shape, ...], arrays: Arrays, seen: Features, image: tuple[int, int]) -> Residuals:
    """Differences between simulated and seen outlines, moments and flow that change wherever the objects are.

    Unlike overlaps of masks they do not vanish where simulated and seen objects are far apart. Simulated ones are those
    of whole silhouettes: ``seen`` must leave out what something hid or the border cut.

    Args:
      shapes: of the objects.
      arrays: poses, sizes and cameras.
      seen: of as many frames and objects.
      image: (width, height) [px].
    """
    placed = place(shapes, arrays, image)
    dtype = placed.centre.dtype
    seen = jax.tree.map(lambda a: jnp.asarray(a, dtype), seen)
    normals = jnp.asarray(directions(seen.reach.shape[-1]), dtype)
    middle = 0.5 * image[0] * normals[:, 0] + 0.5 * image[1] * normals[:, 1]
    reach = jnp.stack([support_of(shape, placed, n, normals) for n, shape in enumerate(shapes)], 2) + middle
    simulated = moments_of(shapes, placed, image)
    # An unknown matrix is unknown as a whole.
    known = jnp.isfinite(seen.moments.second).all((-1, -2), keepdims=True)
    spread = _spread(jnp.where(known, seen.moments.second, 1.0))
    return Residuals(
        reach=_difference(reach, seen.reach),
        radius=_difference(
            _radius(simulated.area), jnp.where(seen.moments.area >= 0, _radius(seen.moments.area), jnp.nan)
        ),
        centroid=_difference(simulated.centroid, seen.moments.centroid),
        spread=jnp.where(known[..., 0], _spread(simulated.second) - spread, 0.0),
        flow=_difference(point_flow_function(shapes, arrays, jnp.asarray(seen.pixels), image), seen.flow),
    )
