"""What effects change of outlines and of flow at points, without drawing a picture."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.compile_cache import jit_quickly
from mjx_refine.effects import acting
from mjx_refine.effects.kind import OutlineView
from mjx_refine.scene import Shape
from mjx_refine.view.outline import Arrays, directions, larger, padded, place, support_of, supports
from mjx_refine.view.points import point_flow

MANY = 64, 128
"""Directions that effects ask for, so that what is compiled is known: 64 tell what bulges, is worn or is hidden, 128 what is left
of corners where outlines shrink."""

LEAST_AREA = 1.0
"""Area [px^2] below which a part of a silhouette has no centroid."""

UNBENDING = 6
"""Steps that undo a lens, each of which leaves at most 3 |k1| r^2 of what the last one left (r in focal lengths)."""


def directions_for(batch: SceneBatch, count: int) -> int:
    """How many directions, a multiple of ``count``, the effects of ``batch`` need."""
    return count * max(-(-acting.directions_of_outlines(batch) // count), 1)


def outline_function(shapes: tuple[Shape, ...], arrays: Arrays, image: tuple[int, int], count: int):
    """(reach, contact, facing, scale) of every silhouette in ``count`` directions, as ``OutlineView`` has them; pure."""
    placed = place(shapes, arrays, image)
    normals = jnp.asarray(directions(count), placed.centre.dtype)
    tangents = jnp.stack([-normals[:, 1], normals[:, 0]], -1)
    reach, contact, facing, scale = [], [], [], []
    for n, shape in enumerate(shapes):
        h, slope = jax.jvp(functools.partial(support_of, shape, placed, n), (normals,), (tangents,))
        # A convex outline's contact point is the gradient of its support function (Schneider, 1.7).
        point = h[..., None] * normals + slope[..., None] * tangents
        lean = h / placed.focal
        outward = jnp.concatenate([jnp.broadcast_to(normals, (*h.shape, 2)), -lean[..., None]], -1)
        length = jnp.sqrt(1 + lean**2)
        local = (placed.axes[:, :, n, None] * (outward / length[..., None])[..., :, None]).sum(-2)
        reach.append(h)
        contact.append(point + 0.5 * jnp.asarray(image, h.dtype))
        facing.append(local)
        scale.append(placed.focal * length / larger(placed.shown[:, :, n, 2], 0.05)[..., None])
    middle = 0.5 * image[0] * normals[:, 0] + 0.5 * image[1] * normals[:, 1]
    return jnp.stack(reach, 2) + middle, jnp.stack(contact, 2), jnp.stack(facing, 2), jnp.stack(scale, 2)


_outline = jit_quickly(outline_function, static_argnums=(0, 2, 3))


def changed_polygon(
    batch: SceneBatch, view: OutlineView, change: Float[np.ndarray, "batch frames objects directions"]
) -> tuple[
    Float[np.ndarray, "batch frames objects directions 2"], Float[np.ndarray, "batch frames objects others 2"] | None
]:
    """Polygons of points of silhouettes that effects change by ``change``, and of what they hide of these [px], if anything.

    Points of the polygon of contact points go where effects move them, and to first order along its normals where these widen
    it. Where directions are many, what is widened moves along its tangents as well, as gradients of the changed support
    function do.
    """
    shift = acting.outlines_moved(batch, view)
    moved = view.contact if shift is None else view.contact + shift
    hidden = acting.hidden_polygons(batch, moved)
    if hidden is None:
        wider = change if shift is None else change - (shift * view.normals).sum(-1)
        moved = moved + wider[..., None] * view.normals
        if change.shape[-1] >= min(MANY):
            slope = (np.roll(wider, -1, -1) - np.roll(wider, 1, -1)) / (4 * np.pi / wider.shape[-1])
            moved = moved + slope[..., None] * np.stack([-view.normals[:, 1], view.normals[:, 0]], -1)
    return moved, hidden


def changed_moments(
    moments: Float[np.ndarray, "batch frames objects 3"],
    view: OutlineView,
    change: Float[np.ndarray, "batch frames objects directions"],
    moved: Float[np.ndarray, "batch frames objects directions 2"],
    hidden: Float[np.ndarray, "batch frames objects others 2"] | None,
) -> Float[np.ndarray, "batch frames objects 3"]:
    """Centroids and equivalent radii [px] of silhouettes that effects change by ``change``, or hide in part.

    What changes of the moments of polygons, of contact points and of ``changed_polygon``, is added to the exact ones.
    """
    before, after = polygon_sums(view.contact), polygon_sums(moved)
    if hidden is not None:
        after = after - polygon_sums(hidden)
    area = [np.maximum(np.abs(sums[..., 0]), 1e-9) for sums in (before, after)]
    middle = after[..., 1:] / area[1][..., None] - before[..., 1:] / area[0][..., None]
    ratio = np.sqrt(np.abs(after[..., 0]) / area[0])
    seen = np.isfinite(change).any(-1) & (ratio > 0.05)
    result = np.concatenate([moments[..., :2] + middle, (moments[..., 2] * ratio)[..., None]], -1)
    return np.where(seen[..., None], result, np.nan)


def within_function(
    moments: Float[Array, "batch frames objects 3"],
    planes: Float[Array, "frames objects 3"],
    polygon: Float[Array, "batch frames objects directions 2"],
    hidden: Float[Array, "batch frames objects others 2"] | None = None,
) -> Float[Array, "batch frames objects 3"]:
    """Centroids and equivalent radii [px] of what of silhouettes lies within half planes; pure.

    Args:
      moments: of whole silhouettes.
      planes: (normal x, normal y, offset) of n . p <= o; NaN where there is none.
      polygon: points of the silhouettes, of which what lies beyond is taken away.
      hidden: polygons of what is hidden of them anyway.
    """
    normal, offset = planes[..., :2], planes[..., 2]
    # The point of the line that is nearest: integrals over a large picture would cancel.
    origin = moments[..., :2] - normal * ((moments[..., :2] * normal).sum(-1) - offset)[..., None]
    area = jnp.pi * moments[..., 2:] ** 2
    rest = jnp.concatenate([area, area * (moments[..., :2] - origin)], -1)
    rest = rest - _sums_beyond(polygon - origin[..., None, :], normal)
    if hidden is not None:
        rest = rest + _sums_beyond(hidden - origin[..., None, :], normal)
    left = rest[..., :1] > LEAST_AREA
    middle = rest[..., 1:] / jnp.where(left, rest[..., :1], 1.0) + origin
    radius = jnp.sqrt(jnp.maximum(rest[..., :1], 0.0) / jnp.pi)
    within = jnp.where(left, jnp.concatenate([middle, radius], -1), jnp.nan)
    return jnp.where(jnp.isfinite(planes), within, moments)


moments_within = jit_quickly(within_function)


def _sums_beyond(
    points: Float[Array, "batch frames objects corners 2"], normal: Float[Array, "frames objects 2"]
) -> Float[Array, "batch frames objects 3"]:
    """``polygon_sums`` of the parts of convex polygons beyond lines through the origin.

    The chord along such a line adds nothing to them.
    """
    later = jnp.roll(points, -1, -2)
    height, next_height = ((p * normal[:, :, None]).sum(-1) for p in (points, later))
    ahead, next_ahead = height >= 0, next_height >= 0
    crosses = height / jnp.where(ahead == next_ahead, 1.0, height - next_height)
    start = jnp.where(ahead, 0.0, jnp.where(next_ahead, crosses, 1.0))[..., None]
    end = jnp.where(next_ahead, 1.0, jnp.where(ahead, crosses, start[..., 0]))[..., None]
    first, last = points + start * (later - points), points + end * (later - points)
    cross = first[..., 0] * last[..., 1] - last[..., 0] * first[..., 1]
    return jnp.concatenate([cross.sum(-1)[..., None] / 2, ((first + last) * cross[..., None]).sum(-2) / 6], -1)


def polygon_sums(points: Float[np.ndarray, "*grid corners 2"]) -> Float[np.ndarray, "*grid 3"]:
    """Integrals of 1, x and y over polygons, positive for those that turn from x towards y (Green's theorem)."""
    x, y = np.ascontiguousarray(points[..., 0]), np.ascontiguousarray(points[..., 1])
    later_x, later_y = (np.concatenate([a[..., 1:], a[..., :1]], -1) for a in (x, y))
    cross = x * later_y - later_x * y
    first = [np.einsum("...i,...i->...", a, cross) / 6 for a in (x + later_x, y + later_y)]
    return np.stack([cross.sum(-1) / 2, *first], -1)


def focal_length(batch: SceneBatch, image: tuple[int, int]) -> Float[np.ndarray, "batch"]:
    """Focal lengths [px]."""
    return (image[1] / 2) / np.tan(batch.camera_fovy / 2)


def outline_view(
    poses: Float[np.ndarray, "batch frames objects 7"],
    batch: SceneBatch,
    image: tuple[int, int],
    count: int,
    fps: float,
) -> OutlineView:
    """The silhouettes of ``poses``, which are ``apparent`` ones, in ``count`` directions."""
    told = _outline(batch.shapes, padded(poses, batch), image, count)
    reach, contact, facing, scale = (np.asarray(a, np.float64)[: len(poses)] for a in told)
    rate = np.gradient(reach, axis=1) if reach.shape[1] > 1 else np.zeros_like(reach)
    focal = focal_length(batch, image)
    return OutlineView(
        reach, contact, rate, directions(count), facing, scale, focal, image, fps, batch.shapes, batch.size
    )


def seen_supports(
    poses: Float[np.ndarray, "batch frames objects 7"],
    batch: SceneBatch,
    image: tuple[int, int],
    count: int,
    fps: float,
) -> Float[np.ndarray, "batch frames objects directions"]:
    """``supports`` with the effects of ``batch`` [px]; NaN where they hide everything."""
    seen = acting.apparent(poses, batch, fps)
    if not acting.changes_outlines(batch):
        return supports(seen, batch, image, count)
    many = directions_for(batch, count)
    view = outline_view(seen, batch, image, many, fps)
    return (view.reach + acting.outline_change(batch, view))[..., :: many // count]


def seen_point_flow(
    poses: Float[np.ndarray, "batch frames objects 7"],
    batch: SceneBatch,
    pixels: Float[np.ndarray, "frames objects points 2"],
    image: tuple[int, int],
    fps: float,
) -> Float[np.ndarray, "batch frames objects points 2"]:
    """``point_flow`` with the effects of ``batch`` [px/frame]."""
    seen = acting.apparent(poses, batch, fps)
    if not bends(batch):
        return point_flow(seen, batch, pixels, image)
    where, start = straight_pixels(seen, batch, pixels, image, fps)
    return bent_flow(point_flow(seen, batch, where, image), start, pixels, batch, image, fps)


Look: TypeAlias = Callable[
    [np.ndarray, SceneBatch, np.ndarray | None, tuple[int, int], int, float], tuple[np.ndarray, np.ndarray | None]
]
"""What ``seen_reach_and_flow`` takes and gives."""


def seen_reach_and_flow(
    poses: Float[np.ndarray, "batch frames objects 7"],
    batch: SceneBatch,
    pixels: Float[np.ndarray, "frames objects points 2"] | None,
    image: tuple[int, int],
    count: int,
    fps: float,
) -> tuple[
    Float[np.ndarray, "batch frames objects directions"], Float[np.ndarray, "batch frames objects points 2"] | None
]:
    """``seen_supports``, and ``seen_point_flow`` where ``pixels`` are given."""
    flow = None if pixels is None else seen_point_flow(poses, batch, pixels, image, fps)
    return seen_supports(poses, batch, image, count, fps), flow


def bends(batch: SceneBatch) -> bool:
    """Whether at a pixel is seen what would be elsewhere without a lens, or at the frame's own moment."""
    return acting.warps(batch) or rolls(batch)


def straight_pixels(
    seen: Float[np.ndarray, "batch frames objects 7"],
    batch: SceneBatch,
    pixels: Float[np.ndarray, "frames objects points 2"],
    image: tuple[int, int],
    fps: float,
) -> tuple[Float[np.ndarray, "batch frames objects points 2"], Float[np.ndarray, "batch frames objects points 2"]]:
    """Where what is seen at ``pixels`` would be without a lens and at its frame's moment [px], and what its flow there is added
    to for it to end where it is seen next but for the lens [px]: objects go as their centres do.

    Args:
      seen: ``apparent`` poses.
      batch: with its effects.
      pixels: of each object [px].
      image: (width, height) [px].
      fps: frames a second.
    """
    here = np.broadcast_to(pixels[None], (len(seen), *pixels.shape))
    straight = _unwarped(batch, here, focal_length(batch, image), image)
    if not rolls(batch) or seen.shape[1] < 2:
        return straight, straight
    velocity = np.gradient(_centres(seen, batch, image), axis=1)[..., None, :]
    gain = np.gradient(velocity, axis=1)
    late = (readout(batch, fps, image) * (here[..., 1] - 0.5 * image[1]))[..., None]
    return straight - late * (velocity + 0.5 * late * gain), straight + late * gain


def bent_flow(
    flow: Float[np.ndarray, "batch frames objects points 2"],
    start: Float[np.ndarray, "batch frames objects points 2"],
    pixels: Float[np.ndarray, "frames objects points 2"],
    batch: SceneBatch,
    image: tuple[int, int],
    fps: float,
) -> Float[np.ndarray, "batch frames objects points 2"]:
    """Flow at ``pixels`` as lens and shutter show it [px/frame]; ``flow`` is that without them where ``straight_pixels`` says,
    and ``start`` what it says that is added to."""
    bent = acting.warped(batch, start + flow, focal_length(batch, image), image) - pixels
    return bent if not rolls(batch) else bent * (1 + readout(batch, fps, image) * bent[..., 1])[..., None]


def _unwarped(
    batch: SceneBatch,
    here: Float[np.ndarray, "batch frames objects points 2"],
    focal: Float[np.ndarray, "batch"],
    image: tuple[int, int],
) -> Float[np.ndarray, "batch frames objects points 2"]:
    """Where without a lens is what is seen at ``here`` [px]: near it, since a lens bends pictures a little."""
    straight = here
    for _ in range(UNBENDING if acting.warps(batch) else 0):
        straight = straight + here - acting.warped(batch, straight, focal, image)
    return straight


def _centres(
    seen: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch, image: tuple[int, int]
) -> Float[np.ndarray, "batch frames objects 2"]:
    """Where the camera, standing still, sees the middles of objects [px]."""
    axes, place = acting.camera_path(dataclasses.replace(batch, effects=()), 1, 1.0)
    local = np.einsum("btji,btnj->btni", axes, seen[..., :3] - place[:, :, None])
    depth = np.maximum(-local[..., 2:], 0.02)
    return focal_length(batch, image)[:, None, None, None] * local[..., :2] * [1.0, -1.0] / depth + np.divide(image, 2)


def rolls(batch: SceneBatch) -> bool:
    """Whether rows are exposed one after another."""
    return any(e.name == "rolling_shutter" for e in batch.effects)


def readout(batch: SceneBatch, fps: float, image: tuple[int, int]) -> Float[np.ndarray, "batch 1 1 1"]:
    """How much later a row is exposed than the one above it [frames]; for first-order changes of flow."""
    told = sum((e.values[:, 0] for e in batch.effects if e.name == "rolling_shutter"), np.zeros(len(batch)))
    return np.asarray(told)[:, None, None, None] * fps / image[1]
