"""Masks and flow of many scenes of all kinds at once: only tiles that an object can reach are drawn.

Tiles are sorted by the kinds of the objects that can reach them, nearly always one or two; those of all scenes and frames go
through the ray caster together, in chunks of one size. So a dozen programs draw every scene of every kind, and a pixel's
value does not depend on what is drawn beside it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float16, Int, UInt8

from mjx_refine.batch import SceneBatch
from mjx_refine.generate.options import FRAMES, SIZE
from mjx_refine.generate.tiles import GRID, SIDE, bounding_boxes
from mjx_refine.scene import SHAPES, Shape
from mjx_refine.view.frames import Frames, frames_of_batch
from mjx_refine.view.rays import cast

CAPACITY = 256
"""Objects whose frames are prepared together; the last stands for no object."""

CHUNK = {"cpu": 1024}
CHUNK_ELSEWHERE = 16384
"""Tiles in one kernel call, by JAX's name of the platform."""


FINEST = 1 / 4096
"""Flow is rounded to this [px], a little above float32's noise here, so that what rests has none."""


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Masks and flow of one clip where objects are seen; all else is background, whose flow is zero.

    Attributes:
      runs: (pixels of background before it, pixels, object's number from 1) of each horizontal run of one object, over
        all frames in one row-by-row sequence.
      flow: (x, y) of the runs' pixels of all frames but the last, in that order [px/frame].
      pixels: how many show each object.
    """

    runs: Int[np.ndarray, "3 runs"]
    flow: Float16[np.ndarray, "2 pixels"]
    pixels: Int[np.ndarray, "objects"]


@dataclasses.dataclass(frozen=True)
class Clip:
    """What to draw.

    Attributes:
      qpos: poses in every frame.
      batch: sizes and cameras.
      row: which scene of ``batch``.
    """

    qpos: Float[np.ndarray, "frames objects 7"]
    batch: SceneBatch
    row: int


@dataclasses.dataclass
class _Work:
    """Tiles of one signature: what they are of, and where their pixels go.

    Attributes:
      frames: for each tile and slot a row of the prepared frames.
      lead: a row whose camera is the tile's.
      corner: (row, column) of the tile.
      labels: the number of each slot's object, after a 0 for the background.
      place: in the output.
    """

    frames: list[np.ndarray] = dataclasses.field(default_factory=list)
    lead: list[np.ndarray] = dataclasses.field(default_factory=list)
    corner: list[np.ndarray] = dataclasses.field(default_factory=list)
    labels: list[np.ndarray] = dataclasses.field(default_factory=list)
    place: list[np.ndarray] = dataclasses.field(default_factory=list)


def draw_clips(clips: Sequence[Clip]) -> list[Pictures]:
    """Masks and flow of every clip."""
    return [picture for part in _parts(clips) for picture in _draw_part(part)]


def _parts(clips: Sequence[Clip]) -> Iterator[list[Clip]]:
    part: list[Clip] = []
    for clip in clips:
        if part and sum(c.qpos.shape[1] for c in part) + clip.qpos.shape[1] >= CAPACITY:
            yield part
            part = []
        part.append(clip)
    if part:
        yield part


def _draw_part(clips: list[Clip]) -> list[Pictures]:
    work: dict[tuple[Shape, ...], _Work] = {}
    places, start, first = [], 0, 0
    for clip in clips:
        where = _sort_tiles(clip, first, start, work)
        places.append((where, slice(start, start + len(where))))
        first, start = first + clip.qpos.shape[1], start + len(where)
    frames = jax.device_put(_prepared(clips))
    size = CHUNK.get(_platform(), CHUNK_ELSEWHERE)
    under_way = [
        (place, _cast_tiles(signature, frames, *arguments))
        for signature, part in work.items()
        for place, arguments in _chunks(part, size)
    ]  # all, before the first is waited for
    drawn = _Drawn(
        np.empty((start, SIDE * SIDE), np.uint8),
        np.empty((start, 2 * SIDE * SIDE), np.float16),
        np.empty(start, np.int32),
    )
    done = 0
    for place, (some_ids, some_flow) in under_way:
        here = slice(done, done + len(place))
        drawn.ids[here] = np.asarray(some_ids)[: len(place)]
        drawn.flow[here] = np.asarray(some_flow)[: len(place)]
        drawn.row[place] = np.arange(here.start, here.stop)
        done = here.stop
    return [
        _gathered(where, drawn, part, clip.qpos.shape[1]) for clip, (where, part) in zip(clips, places, strict=True)
    ]


@dataclasses.dataclass(frozen=True)
class _Drawn:
    """Tiles as they came back.

    Attributes:
      ids: of every pixel.
      flow: all x, then all y.
      row: where in these a tile stands.
    """

    ids: UInt8[np.ndarray, "tiles samples"]
    flow: Float16[np.ndarray, "tiles values"]
    row: Int[np.ndarray, "tiles"]


def _sort_tiles(clip: Clip, first: int, start: int, work: dict) -> Int[np.ndarray, "tiles 3"]:
    """Adds a clip's tiles to ``work``; returns their (frame, row, column), in that order.

    ``first`` is the number of the clip's first object among the prepared ones, ``start`` its first place in the output.
    """
    touched = bounding_boxes(clip.qpos, clip.batch, clip.row).touched
    code = np.zeros(touched.shape[1:], np.uint32)
    for number, tiles in enumerate(touched):
        code |= tiles.astype(np.uint32) << np.uint32(number)
    where = np.argwhere(code)
    code = code[code > 0]
    for one in np.unique(code):
        here = np.nonzero(code == one)[0]
        time = where[here, 0]
        objects = [n for n in range(len(touched)) if one >> n & 1]
        signature, slots = slots_of(tuple(clip.batch.shapes[n] for n in objects))
        part = work.setdefault(signature, _Work())
        rows, labels = np.empty((len(here), len(signature)), np.int32), np.zeros(len(signature) + 1, np.uint8)
        for k, slot in enumerate(slots):
            rows[:, k] = (CAPACITY - 1) * FRAMES if slot is None else (first + objects[slot]) * FRAMES + time
            labels[k + 1] = 0 if slot is None else objects[slot] + 1
        part.frames.append(rows)
        part.lead.append((first + objects[0]) * FRAMES + time)
        part.corner.append(where[here, 1:])
        part.labels.append(np.broadcast_to(labels, (len(here), len(labels))))
        part.place.append(here + start)
    return where


@functools.cache
def slots_of(shapes: tuple[Shape, ...]) -> tuple[tuple[Shape, ...], tuple[int | None, ...]]:
    """The program for a tile that objects of ``shapes`` (in the order of ``SHAPES``) can reach, and who takes which slot.

    One or two objects have a program of their own. More are rare: they share those with 1, 2, 4, ... slots for each shape,
    of which some stay empty.

    Returns:
      (shapes of the slots, for each slot the number in ``shapes`` of its object, or None).
    """
    if len(shapes) <= 2:
        return shapes, tuple(range(len(shapes)))
    most = max(shapes.count(shape) for shape in SHAPES)
    each = 1 << (most - 1).bit_length()
    slots: list[int | None] = []
    for shape in SHAPES:
        mine = [k for k, other in enumerate(shapes) if other == shape]
        slots += mine + [None] * (each - len(mine))
    return tuple(shape for shape in SHAPES for _ in range(each)), tuple(slots)


def _chunks(part: _Work, size: int) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
    """(places, arguments of ``_cast_tiles``), the arguments filled up to ``size`` rows."""
    whole = [np.concatenate(a) for a in (part.frames, part.lead, part.corner, part.labels)]
    place = np.concatenate(part.place)
    types = (np.int32, np.int32, np.int32, np.uint8)
    for begin in range(0, len(place), size):
        filled = []
        for array, dtype in zip(whole, types, strict=True):
            full = np.zeros((size, *array.shape[1:]), dtype)
            some = array[begin : begin + size]
            full[: len(some)] = some
            filled.append(full)
        yield place[begin : begin + size], tuple(filled)


def _prepared(clips: list[Clip]) -> Frames:
    """Ray-casting coefficients of every object and frame, one row each; the last object is one that nothing hits.

    Each clip's are computed as ``picture.draw`` does, whole and on the CPU, so that both see the same numbers.
    """
    with jax.default_device(_cpu()):
        each = [frames_of_batch(c.qpos[None], c.batch[c.row : c.row + 1], SIZE[1]) for c in clips]
    whole = {}
    for name in (*_OF_OBJECTS, *_OF_CAMERAS):
        parts = [np.asarray(getattr(frames, name)) for frames in each]
        if name in _OF_OBJECTS:
            parts = [part.swapaxes(0, 1) for part in parts]
        else:
            parts = [np.repeat(part[None], c.qpos.shape[1], 0) for part, c in zip(parts, clips, strict=True)]
        told = np.concatenate(parts)
        whole[name] = np.zeros((CAPACITY, *told.shape[1:]), np.float32)
        whole[name][: len(told)] = told
        whole[name] = whole[name].reshape(CAPACITY * FRAMES, *told.shape[2:])
    return Frames(**whole)


@functools.cache
def _cpu() -> Any:
    """JAX's CPU; None, its own choice, where it was told to do without."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None


def _platform() -> str:
    chosen = jax.config.jax_default_device
    return getattr(chosen, "platform", None) or jax.default_backend()


@functools.partial(jax.jit, static_argnums=0)
def _cast_tiles(
    signature: tuple[Shape, ...],
    frames: Frames,
    index: Int[Array, "tiles slots"],
    lead: Int[Array, "tiles"],
    corner: Int[Array, "tiles 2"],
    labels: Int[Array, "tiles labels"],
) -> tuple[UInt8[Array, "tiles samples"], Float16[Array, "tiles values"]]:
    """Numbers of objects and flow (all x, then all y) of every pixel of the tiles, row by row."""
    each = {name: getattr(frames, name)[index] for name in _OF_OBJECTS}
    part = Frames(**each, **{name: getattr(frames, name)[lead] for name in _OF_CAMERAS})
    line, column = jnp.meshgrid(jnp.arange(SIDE), jnp.arange(SIDE), indexing="ij")
    x = (corner[:, 1, None] * SIDE + column.reshape(1, -1)).astype(jnp.float32) + 0.5
    y = (corner[:, 0, None] * SIDE + line.reshape(1, -1)).astype(jnp.float32) + 0.5
    slots, flow_x, flow_y = cast(signature, part, x, y, (SIZE[0] / 2, SIZE[1] / 2))
    ids = jnp.take_along_axis(labels, slots, axis=1)
    flow = jnp.round(jnp.stack([flow_x, flow_y], 1) / FINEST) * FINEST
    return ids.astype(jnp.uint8), flow.astype(jnp.float16).reshape(len(index), -1)


_OF_OBJECTS = ("ray", "origin", "size", "next_matrix", "next_offset")
_OF_CAMERAS = ("down", "height", "focal")


def _gathered(where: Int[np.ndarray, "tiles 3"], drawn: _Drawn, part: slice, objects: int) -> Pictures:
    """Runs and flow row by row, from tiles in the order of frame, row and column."""
    rows = drawn.row[part]
    ids = drawn.ids[rows]
    hit = ids.any(1)
    rows, ids, (time, row, column) = rows[hit], ids[hit], where[hit].T.astype(np.int32)
    band = time * GRID[0] + row
    start = np.flatnonzero(np.diff(band, prepend=-1))
    length = np.diff(start, append=len(band))
    rank = np.arange(len(band)) - np.repeat(start, length)
    # Line i of the tiles of a band stands before line i + 1 of any.
    first = SIDE * np.repeat(start, length) + rank
    target = first[:, None] + np.repeat(length, length)[:, None] * np.arange(SIDE)
    order = np.empty(target.size, np.int32)
    order[target.reshape(-1)] = np.arange(target.size, dtype=np.int32)
    lines = ((band * SIDE)[:, None] + np.arange(SIDE, dtype=np.int32)) * SIZE[0] + (column * SIDE)[:, None]
    pixel, shown = lines.reshape(-1)[order], ids.reshape(-1, SIDE)[order].reshape(-1)
    moving = SIDE * int(np.searchsorted(pixel, (FRAMES - 1) * SIZE[0] * SIZE[1]))
    source = (rows[:, None] * (2 * SIDE) + np.arange(SIDE, dtype=np.int32)).reshape(-1)[order[: moving // SIDE]]
    flow = drawn.flow.reshape(-1, SIDE)
    inside = shown[:moving] > 0
    values = np.stack([flow[source + k * SIDE].reshape(-1)[inside] for k in range(2)])
    return Pictures(_runs(pixel, shown), values, np.bincount(shown, minlength=objects + 1)[1:])


def _runs(pixel: Int[np.ndarray, "lines"], shown: UInt8[np.ndarray, "samples"]) -> Int[np.ndarray, "3 runs"]:
    """Runs from lines of ``SIDE`` pixels: the number of each one's first pixel, and what all of them show."""
    edge = np.zeros(len(shown), bool)
    edge[::SIDE] = np.diff(pixel, prepend=-2 * SIDE) != SIDE
    edge[1:] |= shown[1:] != shown[:-1]
    start = np.flatnonzero(edge)
    length = np.diff(start, append=len(shown))
    seen = shown[start] > 0
    start, length = start[seen], length[seen]
    begin = pixel[start // SIDE] + start % SIDE
    gap = begin - np.concatenate([[0], (begin + length)[:-1]])[: len(begin)]
    return np.stack([gap, length, shown[start]]).astype(np.int32)


def expanded(
    runs: Int[np.ndarray, "3 runs"], flow: Float16[np.ndarray, "2 pixels"]
) -> tuple[UInt8[np.ndarray, "frames height width"], Float16[np.ndarray, "intervals height width 2"]]:
    """Whole masks and flow of ``Pictures``."""
    gap, length, number = runs.astype(np.int64)
    start = np.cumsum(gap + length) - length
    pixel = np.repeat(start - (np.cumsum(length) - length), length) + np.arange(length.sum())
    masks = np.zeros(FRAMES * SIZE[1] * SIZE[0], np.uint8)
    masks[pixel] = np.repeat(number, length)
    whole = np.zeros(((FRAMES - 1) * SIZE[1] * SIZE[0], 2), np.float16)
    whole[pixel[: flow.shape[1]]] = flow.T
    return masks.reshape(FRAMES, SIZE[1], SIZE[0]), whole.reshape(FRAMES - 1, SIZE[1], SIZE[0], 2)
