"""Scores of many candidates against one observation: only tiles that an object can reach are drawn.

Objects cover a few per cent of a view. Every frame is cut into square tiles of samples; tiles that no object's bounding
box touches hold background, whose sums are known beforehand; the others of all candidates and frames are gathered into
chunks of a fixed size and drawn, compared and summed in one kernel.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from mjx_fitness import UNMATCHED, Scores, Sums, Weights, scores_from_sums

from mjx_refine.batch import SceneBatch
from mjx_refine.observation import Observation
from mjx_refine.scene import Shape
from mjx_refine.view.frames import Frames, compiled_frames
from mjx_refine.view.outline import padded, supports
from mjx_refine.view.rays import cast

SIDE = 8
"""Samples along a tile's edge."""

CHUNKS = (256, 2048, 8192)
"""Tiles in one kernel call; a batch's tiles go into the largest that fit, so that few sizes are ever compiled."""

ROWS = (1, 16, 128)
"""Candidates that it chooses from (``outline.padded``): a clip's own numbers of samples, elites and parameters ask for no
compilation."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Tiles:
    """The observation in tiles; P = SIDE^2 samples a tile, K tiles a frame, T frames."""

    x: Float[Array, "tiles samples"]
    y: Float[Array, "tiles samples"]
    ids: Int[Array, "frames tiles samples"]
    flow_x: Float[Array, "frames tiles samples"]
    flow_y: Float[Array, "frames tiles samples"]


def _lattice(full: int, wanted: int) -> np.ndarray:
    """Indices of ``wanted`` samples spread over ``full`` pixels, padded with -1 to whole tiles."""
    index = np.floor((np.arange(wanted) + 0.5) * full / wanted).astype(np.int64)
    return np.concatenate([index, np.full(-wanted % SIDE, -1)])


def _picked(frames: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Rows and columns of every frame; the frames themselves where that is all of them in order."""
    for axis, index in ((1, rows), (2, columns)):
        if not np.array_equal(index, np.arange(frames.shape[axis])):
            frames = frames.take(index, axis)
    return frames


def _tiled(image: np.ndarray) -> np.ndarray:
    """(T, rows, columns) -> (T, tiles, SIDE * SIDE)."""
    frames, rows, columns = image.shape
    split = image.reshape(frames, rows // SIDE, SIDE, columns // SIDE, SIDE)
    return split.swapaxes(2, 3).reshape(frames, -1, SIDE * SIDE)


class TileScorer:
    """Scores candidates of one scene kind against one observation.

    Args:
      shapes: the scene kind.
      observation: what was seen; without masks its moving region is the foreground.
      matching: for each object its mask's id, or ``UNMATCHED``.
      resolution: (width, height) of the samples; every sample is a pixel of the full picture, so that a coarse score
        estimates the full one, in the same pixels, without redrawing anything at another size.
      weights: of the fitness.
    """

    def __init__(
        self,
        shapes: tuple[Shape, ...],
        observation: Observation,
        matching: tuple[int, ...],
        resolution: tuple[int, int] | None = None,
        weights: Weights | None = None,
    ):
        self.shapes, self.weights = shapes, weights or Weights()
        self.image = observation.size
        self.length = observation.length
        self.moving_only = observation.masks is None
        width, height = resolution or self.image
        self.resolution = (min(width, self.image[0]), min(height, self.image[1]))
        self._columns = _lattice(self.image[0], self.resolution[0])
        self._rows = _lattice(self.image[1], self.resolution[1])
        self._build(observation, matching)

    def _build(self, observation: Observation, matching: tuple[int, ...]) -> None:
        rows, columns = self._rows, self._columns
        outside = (rows[:, None] < 0) | (columns[None, :] < 0)
        masks = _picked(foreground(observation), rows, columns)
        if outside.any():
            masks[:, outside] = 0
        # Objects cover a few per cent of a view: what is said of them is worked out there alone.
        where = np.nonzero(masks)
        own = np.full(len(where[0]), len(self.shapes) + 1, np.int32)
        for n, i in enumerate(matching):
            if i != UNMATCHED:
                own[masks[where] == i] = n + 1
        ids = np.zeros(masks.shape, np.int32)
        ids[where] = own
        flow = np.full((2, self.length, *outside.shape), np.nan, np.float32)
        flow[:, :-1] = np.moveaxis(_picked(observation.flow, rows, columns), -1, 0)
        if outside.any():
            flow[:, :, outside] = np.nan
        x = np.where(outside, -1e6, columns[None, :] + 0.5)
        y = np.where(outside, -1e6, rows[:, None] + 0.5)
        self.grid = (len(rows) // SIDE, len(columns) // SIDE)
        self._tiles = _Tiles(
            x=jnp.asarray(_tiled(x[None])[0], jnp.float32),
            y=jnp.asarray(_tiled(y[None])[0], jnp.float32),
            ids=jnp.asarray(_tiled(ids)),
            flow_x=jnp.asarray(_tiled(flow[0])),
            flow_y=jnp.asarray(_tiled(flow[1])),
        )
        speed = np.sqrt(flow[0] * flow[0] + flow[1] * flow[1])
        valid = np.isfinite(speed)
        if not valid.all():
            speed[~valid] = 0.0

        def sums(values: np.ndarray) -> np.ndarray:
            """Of what is told of each pixel of objects, by frame."""
            return np.bincount(where[0], values, self.length).astype(np.float64)

        self._observed = {
            "foreground": sums(own > 0),
            "objects": np.stack([sums(own == n + 1) for n in range(len(self.shapes))], -1),
            "still": speed.sum((1, 2), dtype=np.float64)[:-1],
            "measured": np.count_nonzero(valid, axis=(1, 2)).astype(np.float64)[:-1],
            "still_object": sums(speed[where])[:-1],
            "measured_object": sums(valid[where])[:-1],
        }

    def __call__(self, poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch) -> Scores:
        """Scores of every candidate; a candidate whose poses are not finite has fitness -inf and IoU 0."""
        bad = np.logical_not(np.isfinite(poses).all((1, 2, 3)))
        poses = np.where(bad[:, None, None, None], [0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 0.0], poses)
        scores = scores_from_sums(self._sums(poses, batch), self.weights)
        fitness = np.where(bad, -np.inf, scores.fitness)
        return dataclasses.replace(scores, fitness=fitness, iou=np.where(bad, 0.0, scores.iou))

    def _active(self, poses: np.ndarray, batch: SceneBatch) -> tuple[np.ndarray, np.ndarray]:
        """(frame of all candidates, tile) of every tile that an object's bounding box touches."""
        reach = supports(poses, batch, self.image, 4)
        right, bottom, left, top = (np.moveaxis(reach, -1, 0) * np.array([1, 1, -1, -1])[:, None, None, None]).astype(
            np.float64
        )
        # Circles are polygons there, which fall short of them by up to 0.5 % of their radius.
        short_x, short_y = 0.005 * (right - left), 0.005 * (bottom - top)
        right, left, bottom, top = right + short_x, left - short_x, bottom + short_y, top - short_y
        # An object that reaches behind the camera has no bounded outline.
        whole = _reaches_camera(poses, batch)

        def span(index: np.ndarray, low: np.ndarray, high: np.ndarray, full: int) -> np.ndarray:
            valid = np.where(index < 0, full, index)
            edges = valid.reshape(-1, SIDE)
            first, last = edges[:, 0] - 1.0, np.where(index < 0, -1, index).reshape(-1, SIDE).max(1) + 2.0
            touches = (low[..., None] <= last) & (high[..., None] >= first)
            return touches | whole[..., None]

        columns = span(self._columns, left, right, self.image[0])
        rows = span(self._rows, top, bottom, self.image[1])
        touched = np.zeros((*poses.shape[:2], *self.grid), bool)
        for n in range(len(self.shapes)):
            touched |= rows[:, :, n, :, None] & columns[:, :, n, None, :]
        frame, tile = np.nonzero(touched.reshape(poses.shape[0] * poses.shape[1], -1))
        return frame.astype(np.int32), tile.astype(np.int32)

    def _sums(self, poses: np.ndarray, batch: SceneBatch) -> Sums:
        count, length = poses.shape[:2]
        frames = compiled_frames(*padded(poses, batch, ROWS), self.image[1])
        frame, tile = self._active(poses, batch)
        totals = np.zeros((6 + 2 * len(self.shapes), count * length))
        start = 0
        while start < len(frame):
            left = len(frame) - start
            size = next((c for c in CHUNKS if c >= left), CHUNKS[-1])
            part = slice(start, start + size)
            index, where = _padded(frame[part], size), _padded(tile[part], size)
            parts = np.asarray(
                _chunk(self.shapes, self.image, self.moving_only, frames, self._tiles, index, where, length)
            )
            for k, values in enumerate(parts[:, : min(left, size)]):
                totals[k] += np.bincount(frame[part], values, count * length)
            start += size
        return self._finish(totals.reshape(-1, count, length))

    def _finish(self, totals: np.ndarray) -> Sums:
        intersection, predicted, error, object_error = totals[0], totals[1], totals[2], totals[3]
        still, object_still = totals[4], totals[5]
        n = len(self.shapes)
        object_intersection = np.moveaxis(totals[6 : 6 + n], 0, -1)
        object_predicted = np.moveaxis(totals[6 + n :], 0, -1)
        seen = self._observed

        def repeated(name: str) -> np.ndarray:
            return np.broadcast_to(seen[name], (totals.shape[1], *seen[name].shape))

        return Sums(
            intersection=intersection,
            union=repeated("foreground") + predicted - intersection,
            object_intersection=object_intersection,
            object_union=repeated("objects") + object_predicted - object_intersection,
            # Tiles that were not drawn hold still background.
            error=repeated("still") + (error - still)[:, :-1],
            measured=repeated("measured"),
            object_error=repeated("still_object") + (object_error - object_still)[:, :-1],
            object_measured=repeated("measured_object"),
        )


def foreground(observation: Observation) -> Int[np.ndarray, "frames height width"]:
    """The masks or, where there are none, 1 wherever the flow moves (the last frame is then empty).

    What moves is what is faster than five times the background's median speed, and than half a pixel.
    """
    if observation.masks is not None:
        return observation.masks
    speed = np.nan_to_num(np.linalg.norm(observation.flow, axis=-1))
    threshold = max(0.5, 5 * float(np.median(speed)))
    moving = (speed > threshold).astype(np.int32)
    return np.concatenate([moving, np.zeros_like(moving[:1])])


def _padded(values: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([values, np.zeros(size - len(values), values.dtype)])


def _reaches_camera(poses: np.ndarray, batch: SceneBatch) -> np.ndarray:
    """Whether an object's bounding sphere reaches the camera's plane, (batch, frames, objects)."""
    relative = poses[..., :3] - batch.camera_position[:, None, None]
    pitch = batch.camera_pitch[:, None, None]
    depth = relative[..., 1] * np.sin(pitch) - relative[..., 2] * np.cos(pitch)
    radius = np.linalg.norm(batch.size, axis=-1)[:, None]
    return (depth < radius + 0.05) & (depth > -radius)


@functools.partial(jax.jit, static_argnames=("shapes", "image", "moving_only", "length"))
def _chunk(shapes, image, moving_only, frames: Frames, tiles: _Tiles, index, where, length: int):
    """(sums, tiles): intersection, predicted, error, object error, the same two of a still picture, per object sums."""
    part = jax.tree.map(lambda a: a[index], frames)
    time = index % length
    ids, flow_x, flow_y = cast(shapes, part, tiles.x[where], tiles.y[where], (image[0] / 2, image[1] / 2))
    seen = tiles.ids[time, where]
    seen_x, seen_y = tiles.flow_x[time, where], tiles.flow_y[time, where]
    if moving_only:
        ids = jnp.where((flow_x * flow_x + flow_y * flow_y > 0.25), ids, 0)
    # Samples beyond the picture's edge only fill up a tile.
    ids = jnp.where(tiles.x[where] < 0, 0, ids)
    measured = jnp.isfinite(seen_x) & jnp.isfinite(seen_y)
    error = jnp.sqrt((flow_x - seen_x) ** 2 + (flow_y - seen_y) ** 2)
    still = jnp.sqrt(seen_x**2 + seen_y**2)
    error, still = jnp.where(measured, error, 0.0), jnp.where(measured, still, 0.0)
    on_object = seen > 0
    columns = [
        jnp.where((ids > 0) & on_object, 1.0, 0.0),
        jnp.where(ids > 0, 1.0, 0.0),
        error,
        jnp.where(on_object, error, 0.0),
        still,
        jnp.where(on_object, still, 0.0),
        *[jnp.where((ids == n + 1) & (seen == n + 1), 1.0, 0.0) for n in range(len(shapes))],
        *[jnp.where(ids == n + 1, 1.0, 0.0) for n in range(len(shapes))],
    ]
    zero = [jnp.float32(0.0)] * len(columns)
    # One reduction with many operands: one pass over the samples, nothing of their size is written to memory.
    return jnp.stack(jax.lax.reduce(columns, zero, lambda a, b: [i + j for i, j in zip(a, b, strict=True)], [1]))
