"""Pictures of scenes with effects: a moving camera, a bent lens, rows exposed one after another, changed outlines.

Every pixel of the picture is taken back through the lens, its ray is cast at the poses of its row's moment, and the
point that it hits is followed to the next frame, where its row may be exposed a little earlier or later.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from mjx_refine.batch import BatchEffect, SceneBatch
from mjx_refine.effects import acting
from mjx_refine.effects.kind import EffectKind
from mjx_refine.effects.mask_bias import width_change
from mjx_refine.effects.registry import acting_kind
from mjx_refine.view.exposure import poses_at, straightened
from mjx_refine.view.outline import supports
from mjx_refine.view.picture import draw
from mjx_refine.view.rows import Rows, cast_rows
from mjx_refine.view.seen import focal_length, outline_view, rolls

DIRECTIONS = 128
"""In which changes of an outline are asked for."""

AHEAD = 0.05
"""Part of a frame over which the speed of points is measured for the rolling shutter."""

FINE = 3
"""Samples along a pixel's edge where masks are widened."""

BLOCK = 2_500_000
"""Pixels that are drawn at a time."""

_RECTANGLE, _WIDTH = "occluder", "mask_bias"


@dataclasses.dataclass(frozen=True)
class Layers:
    """The effects of a batch by how they are drawn.

    Attributes:
      outlined: change outlines through their support functions.
      widening: masks grow by so much [px], (batch,), or None.
      rectangles: (left, top, right, bottom) [px], each (batch, 4), in which nothing is seen.
      bent: whether a lens bends the picture.
      rolling: seconds from the first row to the last, (batch,), or None.
    """

    outlined: tuple[BatchEffect, ...]
    widening: np.ndarray | None
    rectangles: tuple[np.ndarray, ...]
    bent: bool
    rolling: np.ndarray | None


def layers(batch: SceneBatch) -> Layers:
    """How the effects of ``batch`` are drawn."""
    bends = {e.name for e in batch.effects if type(acting_kind(e.name)).warp is not EffectKind.warp}
    special = {_RECTANGLE, _WIDTH, "rolling_shutter", *bends}
    outlines = [e for e in batch.effects if type(acting_kind(e.name)).outline is not EffectKind.outline]
    widths = [e.values[:, 0] for e in batch.effects if e.name == _WIDTH]
    readouts = [e.values[:, 0] for e in batch.effects if e.name == "rolling_shutter"]
    return Layers(
        outlined=tuple(e for e in outlines if e.name not in special),
        widening=sum(widths[1:], widths[0]) if widths else None,
        rectangles=tuple(e.values for e in batch.effects if e.name == _RECTANGLE),
        bent=bool(bends),
        rolling=sum(readouts[1:], readouts[0]) if rolls(batch) else None,
    )


def needs_pictures(batch: SceneBatch) -> bool:
    """Whether an effect changes how poses are seen, so that the plain drawing of ``batch`` would be wrong."""
    seen = acting.changes_outlines(batch) or acting.moves_camera(batch)
    return bool(seen) or acting.floor_rotation(batch) is not None


def draw_effects(
    poses: Float[np.ndarray, "frames objects 7"], batch: SceneBatch, size: tuple[int, int], fps: float, row: int = 0
) -> tuple[Int[np.ndarray, "frames height width"], Float[np.ndarray, "intervals height width 2"]]:
    """Masks and flow [px/frame] of one candidate as ``draw`` has them, with its effects.

    Where something hides the objects, or no light arrives through the lens, the mask is 0 and the flow the background's.
    Masks that are too fat do not move the flow. The background is the floor, or above the horizon what is 50 m away.

    Args:
      poses: of candidate ``row``, as ``Simulator.rollout`` returns them.
      batch: its sizes, camera and effects.
      size: (width, height) [px].
      fps: frames a second.
      row: which candidate of ``batch``.
    """
    if not needs_pictures(batch):
        return draw(poses, batch, size, row)
    one = batch[row : row + 1]
    told, (width, height) = layers(one), size
    columns, lines = np.arange(width) + 0.5, np.arange(height) + 0.5
    block = max(1, BLOCK // (width * height))
    parts = [
        render(poses[None], one, columns, lines, size, fps, slice(t, min(t + block, len(poses))))
        for t in range(0, len(poses), block)
    ]
    masks, flow = (np.concatenate([part[k][0] for part in parts]) for k in range(2))
    if told.widening is not None:
        masks = _widened(masks, poses, one, size, fps, float(told.widening[0]))
        masks = np.where(_hidden(told, columns, lines), 0, masks)
    return masks, flow[:-1]


def render(
    poses: Float[np.ndarray, "batch frames objects 7"],
    batch: SceneBatch,
    columns: Float[np.ndarray, "columns"],
    lines: Float[np.ndarray, "lines"],
    image: tuple[int, int],
    fps: float,
    part: slice,
    widened: bool = False,
) -> tuple[Int[np.ndarray, "batch shown lines columns"], Float[np.ndarray, "batch shown lines columns 2"]]:
    """Ids and flow to the next frame at the points of a grid; the clip's last frame has no flow.

    Args:
      poses: as ``Simulator.rollout`` returns them.
      batch: sizes, cameras and effects.
      columns: x of the points [px].
      lines: y of the points [px].
      image: (width, height) [px].
      fps: frames a second.
      part: which frames.
      widened: also move outlines by ``mask_bias``, each as if nothing hid it; otherwise that effect is left out.
    """
    told, count = layers(batch), len(batch)
    focal = focal_length(batch, image)
    grid = np.stack(np.broadcast_arrays(columns[None, :], lines[:, None]), -1).reshape(1, -1, 2)
    grid = np.repeat(grid, count, 0)
    points, lit = straightened(batch, grid, focal, image) if told.bent else (grid, np.ones(grid.shape[:2], bool))
    visible = lit & ~np.broadcast_to(_hidden(told, columns, lines), (count, len(lines), len(columns))).reshape(
        count, -1
    )
    seen, change = _world(poses, batch, image, fps, told, widened)
    moving = bool(np.diff(seen[:, :, -1], axis=1).any())
    # Rows of one moment each: all lines at once unless they are exposed one after another.
    rows = 1 if told.rolling is None else len(lines)
    late = np.zeros((count, 1)) if told.rolling is None else told.rolling[:, None] * fps * (lines / image[1] - 0.5)
    here, *following = _moments(seen, late, part)
    change = None if change is None else change[:, part]
    rays = _Rays(points.reshape(count, rows, -1, 2), visible.reshape(count, rows, -1), image, moving)
    ids, moved = _cast(here, following[0], batch, rays, change)
    speed = (_cast(here, following[1], batch, rays, change)[1] - moved) / AHEAD if len(following) > 1 else None
    flow = _exposed(points[:, None] + moved, speed, grid, batch, focal, image, told, fps)
    moves = lit[:, None] & ((ids > 0) | moving)
    flow = np.where(moves[..., None], flow, 0.0)
    if (part.stop or len(poses)) >= poses.shape[1]:
        flow[:, -1] = 0.0
    shape = (count, -1, len(lines), len(columns))
    if widened and told.widening is not None:
        return ids.reshape(shape), render(poses, batch, columns, lines, image, fps, part)[1]
    return ids.reshape(shape), flow.astype(np.float32).reshape(*shape, 2)


@dataclasses.dataclass(frozen=True)
class _Rays:
    """Points of the straight picture by rows of one moment, and whether anything is seen there."""

    points: Float[np.ndarray, "batch rows points 2"]
    visible: np.ndarray
    image: tuple[int, int]
    moving: bool


def _world(poses: np.ndarray, batch: SceneBatch, image, fps: float, told: Layers, widened: bool):
    """Objects and the floor as the still camera would see them, and what is added to the outlines [px] or None."""
    tilt = acting.floor_rotation(batch)
    turn = np.array([1.0, 0.0, 0.0, 0.0]) if tilt is None else acting.quaternion_of(tilt)[:, None, None]
    ground = np.zeros((len(batch), poses.shape[1], 1, 7))
    ground[..., 3:] = turn
    seen = acting.apparent(np.concatenate([poses, ground], 2), batch, fps)
    bodies, reach, change = seen[:, :, :-1], None, None
    if told.outlined:
        view = outline_view(bodies, batch, image, DIRECTIONS, fps)
        change = acting.outline_change(dataclasses.replace(batch, effects=told.outlined), view)
        reach = view.reach + change
    if widened and told.widening is not None:
        wide = width_change(supports(bodies, batch, image, DIRECTIONS) if reach is None else reach, told.widening)
        change = wide if change is None else change + wide
    return seen, change


def _moments(seen: np.ndarray, late: np.ndarray, part: slice) -> list[np.ndarray]:
    """Poses (steps, objects, 7) at every row's moment in the frames of ``part``, one frame later and, if rows differ,
    ``AHEAD`` after that; a step is a row of a frame of a candidate."""
    count, frames, bodies = seen.shape[:3]
    first, last, _ = part.indices(frames)
    if not late.any():
        later = np.concatenate([seen[:, 1:], seen[:, -1:]], 1)
        told = [np.repeat(a[:, part, None], late.shape[1], 2) for a in (seen, later)]
    else:
        times = (np.arange(first, last)[:, None] + late[:, None]).reshape(count, -1)
        told = [poses_at(seen, times + more) for more in (0.0, 1.0, 1.0 + AHEAD)]
    return [a.reshape(-1, bodies, 7) for a in told]


def _cast(
    here: np.ndarray, following: np.ndarray, batch: SceneBatch, rays: _Rays, change: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Ids (batch, frames, pixels) and flow (batch, frames, pixels, 2) in the straight picture."""
    count, rows, per_row = rays.points.shape[:3]
    frames = len(here) // count // rows
    owner = np.repeat(np.arange(count), frames * rows)
    size = np.concatenate([batch.size, np.zeros((count, 1, 3))], 1)
    step = np.arange(len(here))
    told = (
        np.stack([here, following], 1),
        size[owner],
        batch.camera_position[owner],
        batch.camera_pitch[owner],
        batch.camera_fovy[owner],
    )
    line, instant = owner * rows + step % rows, owner * frames + step // rows % frames
    moments = Rows(*(jnp.asarray(a, jnp.float32) for a in told), *(jnp.asarray(a, jnp.int32) for a in (line, instant)))
    points = jnp.asarray(rays.points.reshape(count * rows, per_row, 2), jnp.float32)
    visible = jnp.asarray(rays.visible.reshape(count * rows, per_row))
    changes = None if change is None else jnp.asarray(change.reshape(count * frames, *change.shape[2:]), jnp.float32)
    ids, flow = cast_rows(batch.shapes, rays.image, rays.moving, moments, points, visible, changes)
    pixels = (count, frames, rows * per_row)
    return np.asarray(ids).reshape(pixels), np.asarray(flow, np.float64).reshape(*pixels, 2)


def _exposed(ends, speed, grid, batch: SceneBatch, focal, image, told: Layers, fps: float) -> np.ndarray:
    """Flow of the picture from end points of the straight one, at the moment at which their rows are exposed."""
    here = grid[:, None]
    if speed is None:
        return (acting.warped(batch, ends, focal, image) if told.bent else ends) - here
    delay = np.zeros(ends.shape[:-1])
    rate = np.asarray(told.rolling)[:, None, None] * fps / image[1]
    shown = ends
    for _ in range(4):
        shown = ends + speed * delay[..., None]
        shown = acting.warped(batch, shown, focal, image) if told.bent else shown
        # Nothing is followed for more than three frames.
        delay = np.clip(rate * (shown[..., 1] - here[..., 1]), -3.0, 3.0)
    return shown - here


def _hidden(told: Layers, columns: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Where something hides the objects, (batch or 1, lines, columns)."""
    result = np.zeros((1, len(lines), len(columns)), bool)
    for values in told.rectangles:
        left, top, right, bottom = (values[:, k, None, None] for k in range(4))
        x, y = columns[None, None], lines[None, :, None]
        result = result | ((x > left) & (x < right) & (y > top) & (y < bottom))
    return result


def _widened(masks: np.ndarray, poses: np.ndarray, one: SceneBatch, size, fps: float, width: float) -> np.ndarray:
    """Masks whose edges lie ``width`` px farther out; they grow over background alone.

    Distances are those of a grid of a third of a pixel (exact Euclidean: Maurer et al. 2003), hence right to 0.2 px.
    """
    if width == 0 or not masks.any():
        return masks
    margin = int(np.ceil(abs(width))) + 2
    middle, result = FINE // 2, masks.copy()
    count = len(one.shapes)
    covered = masks[:, None] == np.arange(1, count + 1)[:, None, None]
    # Of each object in each frame, as long as the longest needs, so that one size is compiled.
    lines, columns = (_windows(covered.any(axis), margin) for axis in (3, 2))
    for t in np.nonzero(masks.any((1, 2)))[0]:
        depth = np.full((count, *result[t].shape), np.inf)
        for n in np.nonzero(covered[t].any((1, 2)))[0]:
            part = (lines[t][n], columns[t][n])
            grids = [np.arange(p.start + 0.5 / FINE, p.stop, 1 / FINE) for p in part]
            inside = _fine_ids(poses, one, grids, size, fps, int(t)) == n + 1
            if inside.any():
                edges = np.pad(inside, 1, mode="edge")
                depth[n][part] = (_signed_distance(edges)[1:-1, 1:-1] / FINE)[middle::FINE, middle::FINE]
        result[t] = np.where(depth.min(0) <= width, depth.argmin(0) + 1, 0)
    return result


def _windows(covered: Bool[np.ndarray, "frames objects pixels"], margin: int) -> list[list[slice]]:
    """For each frame and object a range that holds what is covered and ``margin`` more on both sides [px], where the picture has
    that; all of the same length, in steps of 32 px."""
    full, seen = covered.shape[2], covered.any(2)
    first = np.where(seen, covered.argmax(2) - margin, 0)
    last = np.where(seen, full - covered[..., ::-1].argmax(2) + margin, 1)
    length = min(-(-int((last - first).max()) // 32) * 32, full)
    return [[slice(k, k + length) for k in row] for row in np.clip(first, 0, full - length).tolist()]


def _signed_distance(inside: np.ndarray) -> np.ndarray:
    """Distance to the edge of a region [samples], negative inside, -inf where there is no edge."""
    if inside.all():
        return np.full(inside.shape, -np.inf)
    away = np.asarray(ndimage.distance_transform_edt(~inside))
    within = np.asarray(ndimage.distance_transform_edt(inside))
    return np.where(inside, 0.5 - within, away - 0.5)


def _fine_ids(poses: np.ndarray, one: SceneBatch, grids: list[np.ndarray], size, fps: float, t: int) -> np.ndarray:
    """Ids of frame ``t`` on a fine grid."""
    return render(poses[None], one, grids[1], grids[0], size, fps, slice(t, t + 1))[0][0, 0]
