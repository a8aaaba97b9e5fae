"""Masks and flow of clips: only tiles that an object can reach are drawn, and only pixels that show one are kept."""

from __future__ import annotations

import collections
import dataclasses
import functools
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Float16, Int, UInt8

from mjx_refine.batch import SceneBatch
from mjx_refine.generate.casting import Drawn, Tiles
from mjx_refine.generate.options import FRAMES, SIZE
from mjx_refine.generate.tiles import HIGH, WIDE, Bounds, bounds, ordered

_AHEAD = 2
"""Parts that the device draws while this process gathers the one before."""


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

    @functools.cached_property
    def bounds(self) -> Bounds:
        """Where its objects may show."""
        return bounds(self.qpos, self.batch, self.row)


def draw_clips(clips: Sequence[Clip]) -> Iterator[Pictures]:
    """Masks and flow of every clip, in order."""
    under_way: collections.deque[_Part] = collections.deque()
    for part in _parts(clips):
        under_way.append(part)
        if len(under_way) > _AHEAD:
            yield from under_way.popleft().pictures()
    while under_way:
        yield from under_way.popleft().pictures()


@dataclasses.dataclass(frozen=True)
class _Part:
    """Clips that are drawn together; for each its number of objects, its tiles and their places."""

    tiles: Tiles = dataclasses.field(default_factory=Tiles)
    clips: list[tuple[int, np.ndarray, slice]] = dataclasses.field(default_factory=list)

    def pictures(self) -> Iterator[Pictures]:
        drawn = self.tiles.drawn()
        for objects, tiles, places in self.clips:
            yield _gathered(tiles, drawn, places, objects)


def _parts(clips: Sequence[Clip]) -> Iterator[_Part]:
    """Each when the device has got it."""
    part = _Part()
    for clip in clips:
        objects = clip.qpos.shape[1]
        if part.tiles.room < objects:
            part.tiles.start()
            yield part
            part = _Part()
        part.clips.append((objects, *part.tiles.add(clip.qpos, clip.batch, clip.row, clip.bounds.touched)))
    if part.clips:
        part.tiles.start()
        yield part


def _gathered(tiles: Int[np.ndarray, "tiles"], drawn: Drawn, places: slice, objects: int) -> Pictures:
    """Runs and flow row by row."""
    source, pixel = ordered(tiles)
    tile, line = np.divmod(source, HIGH)
    tile = drawn.row[places][tile]
    shown = drawn.ids.reshape(-1, WIDE).take(tile * HIGH + line, 0).reshape(-1)
    moving = int(np.searchsorted(pixel, (FRAMES - 1) * SIZE[0] * SIZE[1]))
    lines = drawn.flow.reshape(-1, WIDE)
    inside, first = shown[: moving * WIDE] > 0, (tile * (2 * HIGH) + line)[:moving]
    flow = np.stack([lines.take(first + k * HIGH, 0).reshape(-1)[inside] for k in range(2)])
    runs = _runs(pixel, shown)
    return Pictures(runs, flow, np.bincount(runs[2], runs[1], objects + 1)[1:].astype(np.int64))


def _runs(pixel: Int[np.ndarray, "lines"], shown: UInt8[np.ndarray, "samples"]) -> Int[np.ndarray, "3 runs"]:
    """Runs from lines of ``WIDE`` pixels: the number of each one's first pixel, and what all of them show."""
    edge = np.zeros(len(shown), bool)
    edge[::WIDE] = np.diff(pixel, prepend=-2 * WIDE) != WIDE
    edge[1:] |= shown[1:] != shown[:-1]
    start = np.flatnonzero(edge)
    length = np.diff(start, append=len(shown))
    seen = shown[start] > 0
    start, length = start[seen], length[seen]
    begin = pixel[start // WIDE] + start % WIDE
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
