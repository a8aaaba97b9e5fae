"""Which tiles of the picture an object may show in: a bound that misses none, by numpy alone."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.generate.options import SIZE
from mjx_refine.scene import Shape
from mjx_refine.sim.model import half_extents

HIGH, WIDE = 8, 16
"""Pixels of a tile. A line of one is 16 bytes of numbers and 32 of flow, which numpy moves as quickly as one value."""

GRID = (SIZE[1] // HIGH, SIZE[0] // WIDE)
"""(rows, columns) of tiles."""

_NEAR = 0.05
"""Depth [m] in front of which no picture is bounded."""

_MARGIN = 0.5
"""[px] around a bound, for the float32 of the ray caster. Up and down the lines between rows of tiles are as far from the
pixels' centres by themselves."""

_LINES = np.arange(GRID[0] + 1, dtype=np.float32) * HIGH
"""Between the rows of tiles [px]."""

_SIDES = 8
"""Of the prism about a cylinder."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Where one scene's objects may show, for each row of tiles.

    Attributes:
      low: no pixel left of it shows the object [px].
      high: none right of it; below ``low``: none at all.
      pixels: in no case more than these pixels show an object in one frame.
    """

    low: Float[np.ndarray, "objects frames rows"]
    high: Float[np.ndarray, "objects frames rows"]
    pixels: Float[np.ndarray, "objects frames"]

    @property
    def touched(self) -> Bool[np.ndarray, "objects frames rows columns"]:
        """Which tiles each object may show in."""
        left = np.arange(GRID[1], dtype=np.float32) * WIDE
        return (left < self.high[..., None]) & (left + WIDE > self.low[..., None])

    @property
    def seen(self) -> Bool[np.ndarray, "objects"]:
        """Whether an object may ever be in view."""
        return np.asarray((self.pixels > 0).any(1))


def bounds(qpos: Float[np.ndarray, "frames objects 7"], batch: SceneBatch, row: int) -> Bounds:
    """Bounds of the objects of scene ``row`` in every frame."""
    each = [_bounds(shape, qpos[:, k], batch, row, k) for k, shape in enumerate(batch.shapes)]
    return Bounds(*(np.stack(parts) for parts in zip(*each, strict=True)))


def _bounds(shape: Shape, poses: Float[np.ndarray, "frames 7"], batch: SceneBatch, row: int, number: int):
    """``Bounds``' fields of one object."""
    focal = SIZE[1] / 2 / np.tan(batch.camera_fovy[row] / 2)
    if shape == "sphere":
        radius = batch.size[row, number, 0]
        centre = _in_camera(poses[:, :3], batch, row)
        nearest_depth, farthest_depth = centre[..., 2] - radius, centre[..., 2] + radius
        low, high, top, bottom = _sphere_spans(centre, radius, focal)
    else:
        corners, edges = _corners(shape)
        away = corners * half_extents(batch.shapes, batch.size[row])[number]
        turn = rotations.matrix(rotations.normalise(poses[:, 3:]))
        points = _in_camera(away @ turn.swapaxes(-1, -2) + poses[:, None, :3], batch, row)
        nearest_depth, farthest_depth = points[..., 2].min(-1), points[..., 2].max(-1)
        over = focal / np.maximum(points[..., 2], _NEAR)
        x = (SIZE[0] / 2 + points[..., 0] * over).astype(np.float32)
        y = (SIZE[1] / 2 - points[..., 1] * over).astype(np.float32)
        low, high, top, bottom = *_hull_spans(x, y, edges), y.min(-1), y.max(-1)
    whole, behind = nearest_depth < _NEAR, farthest_depth < _NEAR
    low = np.where(whole[:, None], 0.0, np.clip(low - _MARGIN, 0.0, SIZE[0]))
    high = np.where(behind[:, None], -1.0, np.where(whole[:, None], SIZE[0], np.clip(high + _MARGIN, -1.0, SIZE[0])))
    top, bottom = np.where(whole, 0.0, top - _MARGIN), np.where(whole, SIZE[1], bottom + _MARGIN)
    tall = np.minimum(bottom[:, None], _LINES[1:]) - np.maximum(top[:, None], _LINES[:-1])
    pixels = (np.maximum(high - low, 0.0) * np.clip(tall, 0.0, HIGH)).sum(-1)
    return low, high, pixels


def _in_camera(points: Float[np.ndarray, "*n 3"], batch: SceneBatch, row: int) -> Float[np.ndarray, "*n 3"]:
    """(right, up, ahead) of points, seen from the camera [m]."""
    away = points - batch.camera_position[row]
    cosine, sine = np.cos(batch.camera_pitch[row]), np.sin(batch.camera_pitch[row])
    ahead = away[..., 1] * sine - away[..., 2] * cosine
    return np.stack([away[..., 0], away[..., 1] * cosine + away[..., 2] * sine, ahead], -1)


def _sphere_spans(centre: Float[np.ndarray, "frames 3"], radius: float, focal: float):
    """(left, right) ends in every row of tiles, top and bottom [px], of spheres ahead of the camera.

    The ray (X, Y, 1) meets the sphere where (X a + Y b + c)^2 >= k (X^2 + Y^2 + 1), with (a, b, c) its centre and k the
    squared length of its tangents: an ellipse, whose ends at a height Y are the roots of a quadratic equation in X. Over a
    range of heights each end is farthest out where it is at all, or else at the range's end nearest to that height.
    """
    a, b, c = np.moveaxis(centre, -1, 0)
    # Bounds of those at the camera are not asked for.
    k = np.maximum((centre**2).sum(-1) - radius**2, 1e-9)
    across = np.maximum(c * c - radius**2, 1e-9)

    def ends(middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        reach = radius * np.sqrt(np.maximum(middle**2 + across, 0.0))
        return (middle * c - reach) / across, (middle * c + reach) / across

    def at(height: np.ndarray, sign: int) -> np.ndarray:
        level, width = height * b[:, None] + c[:, None], np.maximum(k - a * a, 1e-9)[:, None]
        root = np.sqrt(np.maximum(k[:, None] * (level**2 - width * (height**2 + 1)), 0.0))
        return (a[:, None] * level + sign * root) / width

    lowest, highest = ends(b)
    upper = (SIZE[1] / 2 - _LINES[:-1]) / focal
    first = np.maximum(upper - HIGH / focal, lowest[:, None])
    last = np.minimum(upper, highest[:, None])
    sides = []
    for sign, outermost in zip((-1, 1), ends(a), strict=True):
        where = b * (outermost * a + c) / np.maximum(k - b * b, 1e-9)
        sides.append(SIZE[0] / 2 + focal * at(np.clip(where[:, None], first, np.maximum(first, last)), sign))
    none = first > last
    left, right = np.where(none, np.inf, sides[0]), np.where(none, -np.inf, sides[1])
    return left, right, SIZE[1] / 2 - focal * highest, SIZE[1] / 2 - focal * lowest


def _hull_spans(x: Float[np.ndarray, "frames points"], y: Float[np.ndarray, "frames points"], edges: tuple):
    """(left, right) ends in every row of tiles of the convex hull of points in the picture: at corners within the row, and
    where edges cross its border."""
    begin, end = edges
    rise = y[:, end] - y[:, begin]
    rise = np.where(rise == 0, np.float32(1e-9), rise)[..., None]
    share = (_LINES - y[:, begin, None]) / rise
    crosses = (share >= 0) & (share <= 1)
    where = x[:, begin, None] + share * (x[:, end] - x[:, begin])[..., None]
    inside = (y[..., None] >= _LINES[:-1]) & (y[..., None] <= _LINES[1:])
    sides = []
    for outside, outermost in ((np.float32(np.inf), np.minimum), (np.float32(-np.inf), np.maximum)):
        line = outermost.reduce(np.where(crosses, where, outside), 1)
        corner = outermost.reduce(np.where(inside, x[..., None], outside), 1)
        sides.append(outermost(outermost(line[:, :-1], line[:, 1:]), corner))
    return sides


@functools.cache
def _corners(shape: Shape) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Corners, for half extents of one, and edges of a box, or of a prism about a cylinder."""
    if shape == "box":
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        edges = [(i, j) for i, j in itertools.combinations(range(8), 2) if np.abs(corners[i] - corners[j]).sum() == 2]
    else:
        angle = (np.arange(_SIDES) + 0.5) * 2 * np.pi / _SIDES
        ring = np.stack([np.cos(angle), np.sin(angle)], -1) / np.cos(np.pi / _SIDES)
        corners = np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-1.0, 1.0)])
        n = range(_SIDES)
        edges = [(k + h, (k + 1) % _SIDES + h) for k in n for h in (0, _SIDES)] + [(k, k + _SIDES) for k in n]
    begin, end = np.array(edges).T
    return corners, (begin, end)


def nearest(qpos: Float[np.ndarray, "frames objects 7"], batch: SceneBatch, row: int) -> float:
    """The least distance from the camera to the sphere about an object's box [m]."""
    radius = np.linalg.norm(half_extents(batch.shapes, batch.size[row]), axis=-1)
    return float((np.linalg.norm(qpos[..., :3] - batch.camera_position[row], axis=-1) - radius).min())


def ordered(place: Int[np.ndarray, "tiles"]) -> tuple[Int[np.ndarray, "lines"], Int[np.ndarray, "lines"]]:
    """The lines of one clip's tiles in the order of the picture.

    Args:
      place: of each tile: (frame * rows + row) * columns + column, ascending.

    Returns:
      (tile * ``HIGH`` + line, the first pixel's number in all frames) of each.
    """
    band, column = np.divmod(place, GRID[1])
    start = np.flatnonzero(np.diff(band, prepend=-1))
    length = np.diff(start, append=len(band))
    begin, count = np.repeat(start, length), np.repeat(length, length)
    line = np.arange(HIGH)
    # Line i of the tiles of a band stands before line i + 1 of any.
    target = (HIGH * begin + np.arange(len(band)) - begin)[:, None] + count[:, None] * line
    source, pixel = np.empty(target.size, np.intp), np.empty(target.size, np.int32)
    source[target] = np.arange(target.size).reshape(target.shape)
    pixel[target] = (band * HIGH * SIZE[0] + column * WIDE)[:, None] + line * SIZE[0]
    return source, pixel
