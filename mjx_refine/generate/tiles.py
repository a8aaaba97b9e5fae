"""Which tiles of the picture an object may show in: a bound that misses none, by numpy alone."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.generate.options import SIZE

SIDE = 8
"""Pixels along a tile's edge."""

GRID = (SIZE[1] // SIDE, SIZE[0] // SIDE)
"""(rows, columns) of tiles."""

_NEAR = 0.05
"""Depth [m] in front of which no picture is bounded."""

_MARGIN = 0.5
"""[px] around a bound, for the float32 of the ray caster."""

_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


@dataclasses.dataclass(frozen=True)
class Boxes:
    """Bounding boxes in the picture of one scene's objects, in whole tiles; first > last: not in view.

    Attributes:
      first: (row, column) of the first tile.
      last: ditto of the last.
      pixels: in no case more than these pixels show an object in one frame.
    """

    first: Int[np.ndarray, "frames objects 2"]
    last: Int[np.ndarray, "frames objects 2"]
    pixels: Float[np.ndarray, "frames objects"]

    @property
    def touched(self) -> Bool[np.ndarray, "objects frames rows columns"]:
        """Which tiles each object may show in."""
        rows, columns = (
            (np.arange(GRID[k]) >= self.first[..., k, None]) & (np.arange(GRID[k]) <= self.last[..., k, None])
            for k in range(2)
        )
        return (rows[..., :, None] & columns[..., None, :]).swapaxes(0, 1)

    @property
    def seen(self) -> Bool[np.ndarray, "objects"]:
        """Whether an object may ever be in view."""
        return np.asarray((self.pixels > 0).any(0))


def bounding_boxes(qpos: Float[np.ndarray, "frames objects 7"], batch: SceneBatch, row: int) -> Boxes:
    """Bounds of the objects of scene ``row`` in every frame: the picture of a box about a body lies within that of its
    corners."""
    extent = _half_extents(batch, row)
    turn = rotations.matrix(rotations.normalise(qpos[..., 3:]))
    corners = (turn[..., None, :, :] * (_CORNERS * extent[:, None])[..., None, :]).sum(-1) + qpos[..., None, :3]
    away = corners - batch.camera_position[row]
    cosine, sine = np.cos(batch.camera_pitch[row]), np.sin(batch.camera_pitch[row])
    depth = away[..., 1] * sine - away[..., 2] * cosine
    up = away[..., 1] * cosine + away[..., 2] * sine
    focal = SIZE[1] / 2 / np.tan(batch.camera_fovy[row] / 2)
    ahead = np.maximum(depth, _NEAR)
    x, y = SIZE[0] / 2 + focal * away[..., 0] / ahead, SIZE[1] / 2 - focal * up / ahead
    first = np.stack([y.min(-1), x.min(-1)], -1) - _MARGIN
    last = np.stack([y.max(-1), x.max(-1)], -1) + _MARGIN
    whole, behind = (depth.min(-1) < _NEAR)[..., None], (depth.max(-1) < _NEAR)[..., None]
    full = np.array(SIZE[::-1], float)
    first = np.where(behind, full, np.where(whole, 0.0, np.clip(first, 0.0, full)))
    last = np.where(behind, 0.0, np.where(whole, full, np.clip(last, 0.0, full)))
    inside = last > first
    return Boxes(
        first=np.where(inside, np.floor(first / SIDE), 1).astype(np.int32),
        last=np.where(inside, np.ceil(last / SIDE) - 1, 0).astype(np.int32),
        pixels=np.maximum(last - first, 0.0).prod(-1),
    )


def nearest(qpos: Float[np.ndarray, "frames objects 7"], batch: SceneBatch, row: int) -> float:
    """The least distance from the camera to an object's bounding sphere [m]."""
    radius = np.linalg.norm(_half_extents(batch, row), axis=-1)
    return float((np.linalg.norm(qpos[..., :3] - batch.camera_position[row], axis=-1) - radius).min())


def _half_extents(batch: SceneBatch, row: int) -> Float[np.ndarray, "objects 3"]:
    """Of the box about each body, along its own axes [m]."""
    size = batch.size[row]
    columns = {"sphere": (0, 0, 0), "cylinder": (0, 0, 1), "box": (0, 1, 2)}
    return np.stack([size[k, columns[shape]] for k, shape in enumerate(batch.shapes)])
