"""Tiles of many scenes of all kinds through the ray caster together, sorted by what can be seen in them.

A tile's program is that of the kinds of the objects that can reach it, nearly always one. So a few programs draw every
scene of every kind, in chunks of one size, and a pixel's value does not depend on what is drawn beside it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float16, Int, UInt8

from mjx_refine.batch import SceneBatch
from mjx_refine.generate.options import FRAMES, SIZE
from mjx_refine.generate.tiles import GRID, HIGH, WIDE
from mjx_refine.scene import SHAPES, Shape
from mjx_refine.view.frames import Frames, compiled_frames
from mjx_refine.view.rays import cast

CAPACITY = 48
"""Objects whose frames are prepared together; the last stands for no object."""

CHUNK = {"cpu": 256}
CHUNK_ELSEWHERE = 4096
"""Tiles in one kernel call, by JAX's name of the platform."""

FINEST = 1 / 4096
"""Flow is rounded to this [px], a little above float32's noise here, so that what rests has none."""


@dataclasses.dataclass
class Work:
    """Tiles of one signature.

    Attributes:
      tiles: numbers within their clip, (frame * rows + row) * columns + column.
      places: in the output.
      objects: for each group of tiles, the prepared object in each slot, and at the end one whose camera is theirs.
      labels: for each group, the number of each slot's object, after a 0 for the background.
    """

    tiles: list[np.ndarray] = dataclasses.field(default_factory=list)
    places: list[np.ndarray] = dataclasses.field(default_factory=list)
    objects: list[tuple[int, ...]] = dataclasses.field(default_factory=list)
    labels: list[tuple[int, ...]] = dataclasses.field(default_factory=list)


class Tiles:
    """Tiles of some clips on their way through the ray caster."""

    def __init__(self) -> None:
        self._few = _platform() == "cpu"
        self._work: dict[tuple[Shape, ...], Work] = {}
        self._clips: list[tuple[np.ndarray, SceneBatch, int]] = []
        self._objects = self._count = 0
        self._chunks: list[tuple[np.ndarray, tuple[Array, Array]]] = []

    @property
    def room(self) -> int:
        """How many objects there is room for."""
        return CAPACITY - 1 - self._objects

    def add(self, qpos: np.ndarray, batch: SceneBatch, row: int, touched: np.ndarray) -> tuple[np.ndarray, slice]:
        """Adds a clip, with its ``Bounds.touched``; returns its tiles' numbers, ascending, and their places."""
        code = np.zeros(touched[0].size, np.uint16)
        for number, tiles in enumerate(touched.reshape(len(touched), -1)):
            code |= tiles.astype(np.uint16) << np.uint16(number)
        tiles = np.flatnonzero(code)
        code = code[tiles]
        order = np.argsort(code, kind="stable")  # by radix
        begins = np.flatnonzero(np.diff(code[order], prepend=np.uint16(0)))
        for begin, end in itertools.pairwise((*begins, len(order))):
            self._group(int(code[order[begin]]), tiles, order[begin:end], batch.shapes)
        place = slice(self._count, self._count + len(tiles))
        self._clips.append((qpos, batch, row))
        self._objects += len(touched)
        self._count += len(tiles)
        return tiles, place

    def _group(self, code: int, tiles: np.ndarray, here: np.ndarray, shapes: tuple[Shape, ...]) -> None:
        reached = [n for n in range(len(shapes)) if code >> n & 1]
        signature, slots = slots_of(tuple(shapes[n] for n in reached), self._few)
        work = self._work.setdefault(signature, Work())
        work.tiles.append(tiles[here])
        work.places.append(here + self._count)
        objects = (CAPACITY - 1 if slot is None else self._objects + reached[slot] for slot in slots)
        work.objects.append((*objects, self._objects + reached[0]))
        work.labels.append((0, *(0 if slot is None else reached[slot] + 1 for slot in slots)))

    def start(self) -> None:
        """Gives everything to the device, without waiting."""
        frames = jax.device_put(_prepared(self._clips))
        size = CHUNK.get(_platform(), CHUNK_ELSEWHERE)
        for signature, work in self._work.items():
            for places, arguments in _chunks(work, size):
                told = _cast_tiles(signature, frames, *arguments)
                for array in told:
                    array.copy_to_host_async()
                self._chunks.append((places, told))

    def drawn(self) -> Drawn:
        """What came out, once it has."""
        ids = np.empty((self._count, HIGH, WIDE), np.uint8)
        flow = np.empty((self._count, 2, HIGH, WIDE), np.float16)
        row, done = np.empty(self._count, np.intp), 0
        for places, told in self._chunks:
            here = slice(done, done + len(places))
            ids[here], flow[here] = (np.asarray(array)[: len(places)] for array in told)
            row[places] = np.arange(here.start, here.stop)
            done = here.stop
        self._chunks.clear()
        return Drawn(ids, flow, row)


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Tiles as they came back.

    Attributes:
      ids: number of the object that each pixel shows.
      flow: all x, then all y, of a tile [px/frame].
      row: where in these the tile of a place stands.
    """

    ids: UInt8[np.ndarray, "tiles high wide"]
    flow: Float16[np.ndarray, "tiles 2 high wide"]
    row: Int[np.ndarray, "tiles"]


@functools.cache
def slots_of(shapes: tuple[Shape, ...], few: bool) -> tuple[tuple[Shape, ...], tuple[int | None, ...]]:
    """The program for a tile that objects of ``shapes`` (in the order of ``SHAPES``) can reach, and who takes which slot.

    With ``few`` slots, one object has a program of its own. More are rare: they share those with 1, 2, 4, ... slots for
    each shape, of which some stay empty. To a GPU an empty slot is nothing: it has one program with four slots for each
    shape, and another where those are too few, and a process begins sooner.

    Returns:
      (shapes of the slots, for each slot the number in ``shapes`` of its object, or None).
    """
    if few and len(shapes) == 1:
        return shapes, (0,)
    most = max(shapes.count(shape) for shape in SHAPES)
    each = max(1 << (most - 1).bit_length(), 1 if few else 4)
    slots: list[int | None] = []
    for shape in SHAPES:
        mine = [k for k, other in enumerate(shapes) if other == shape]
        slots += mine + [None] * (each - len(mine))
    return tuple(shape for shape in SHAPES for _ in range(each)), tuple(slots)


def _chunks(work: Work, size: int) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
    """(places, arguments of ``_cast_tiles``), the arguments filled up to ``size`` rows."""
    tiles, places = np.concatenate(work.tiles), np.concatenate(work.places)
    group = np.repeat(np.arange(len(work.tiles)), [len(some) for some in work.tiles])
    objects, labels = np.array(work.objects, np.int32), np.array(work.labels, np.uint8)
    for begin in range(0, len(tiles), size):
        some = slice(begin, begin + size)
        groups = slice(group[begin], group[some][-1] + 1)
        told = (tiles[some], group[some] - groups.start, objects[groups], labels[groups])
        types = (np.int32, np.int32, np.int32, np.uint8)
        yield places[some], tuple(_filled(array, size, dtype) for array, dtype in zip(told, types, strict=True))


def _filled(array: np.ndarray, size: int, dtype: type) -> np.ndarray:
    full = np.zeros((size, *array.shape[1:]), dtype)
    full[: len(array)] = array
    return full


_OF_OBJECTS = ("ray", "origin", "size", "next_matrix", "next_offset")
_OF_CAMERAS = ("down", "height", "focal")


def _prepared(clips: Sequence[tuple[np.ndarray, SceneBatch, int]]) -> Frames:
    """Ray-casting coefficients of every object and frame, one row each; the last object is one that nothing hits.

    Each clip's are computed as ``picture.draw`` does, whole and on the CPU, so that both see the same numbers.
    """
    with jax.default_device(_cpu()):
        each = [_frames(qpos, batch, row) for qpos, batch, row in clips]
    whole = {}
    for name in (*_OF_OBJECTS, *_OF_CAMERAS):
        parts = [np.asarray(getattr(frames, name)) for frames in each]
        if name in _OF_OBJECTS:
            parts = [part.swapaxes(0, 1) for part in parts]
        else:
            parts = [np.repeat(part[None], qpos.shape[1], 0) for part, (qpos, _, _) in zip(parts, clips, strict=True)]
        told = np.concatenate(parts)
        whole[name] = np.zeros((CAPACITY, *told.shape[1:]), np.float32)
        whole[name][: len(told)] = told
        whole[name] = whole[name].reshape(CAPACITY * FRAMES, *told.shape[2:])
    return Frames(**whole)


def _frames(qpos: np.ndarray, batch: SceneBatch, row: int) -> Frames:
    """``frames_of_batch``, which takes thrice as long, since it gives JAX one array after another."""
    one = slice(row, row + 1)
    arrays = (qpos[None], batch.size[one], batch.camera_position[one], batch.camera_pitch[one], batch.camera_fovy[one])
    return compiled_frames(*(array.astype(np.float32) for array in arrays), SIZE[1])


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
    tile: Int[Array, "tiles"],
    group: Int[Array, "tiles"],
    objects: Int[Array, "groups slots+1"],
    labels: Int[Array, "groups labels"],
) -> tuple[UInt8[Array, "tiles high wide"], Float16[Array, "tiles 2 high wide"]]:
    """Numbers of objects and flow of every pixel of the tiles."""
    band, column = tile // GRID[1], tile % GRID[1]
    time, row = band // GRID[0], band % GRID[0]
    index = objects[group] * FRAMES + time[:, None]
    each = {name: getattr(frames, name)[index[:, :-1]] for name in _OF_OBJECTS}
    part = Frames(**each, **{name: getattr(frames, name)[index[:, -1]] for name in _OF_CAMERAS})
    down, right = jnp.meshgrid(jnp.arange(HIGH), jnp.arange(WIDE), indexing="ij")
    x = (column[:, None] * WIDE + right.reshape(1, -1)).astype(jnp.float32) + 0.5
    y = (row[:, None] * HIGH + down.reshape(1, -1)).astype(jnp.float32) + 0.5
    slots, flow_x, flow_y = cast(signature, part, x, y, (SIZE[0] / 2, SIZE[1] / 2))
    ids = jnp.take_along_axis(labels[group], slots, axis=1)
    flow = jnp.round(jnp.stack([flow_x, flow_y], 1) / FINEST) * FINEST
    shape = (len(tile), HIGH, WIDE)
    return ids.astype(jnp.uint8).reshape(shape), flow.astype(jnp.float16).reshape(shape[0], 2, *shape[1:])
