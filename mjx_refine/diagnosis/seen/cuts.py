"""Straight borders at which masks stop while their objects go on: something that is not in the scene hides the rest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

FRAMES, MOVES = 3, 3.0
"""In how many frames a mask must stop at the same line, and how far its other side or its middle must move meanwhile, across
that line [px]."""

FLAT, LEAST = 0.3, 8
"""Part of the mask's extent along the line that must lie at it, and pixels."""

LEAST_PIXELS = 30
"""Of a mask that is looked at."""

DEEP = 3
"""How far nothing at all must be seen beyond the line [px]."""

MOST_OF = 0.8
"""Part of the border beyond which that must be so."""


class Box(NamedTuple):
    """A rectangle [px]."""

    left: float
    top: float
    right: float
    bottom: float


class _Edge(NamedTuple):
    """Where a mask ends in one frame, seen along one axis.

    Attributes:
      at: the last line of pixels on the side that is looked at.
      low, high: where the mask lies at that line.
      opposite: the last line on the other side.
      middle: the centroid's line.
    """

    at: int
    low: int
    high: int
    opposite: int
    middle: float


def cut_places(masks: Int[np.ndarray, "frames height width"], most: int = 2) -> tuple[Box, ...]:
    """Rectangles that would hide what lies beyond such borders, those of the most frames first.

    Args:
      masks: ids, 0: nothing.
      most: how many rectangles are told.
    """
    found = [
        one
        for i in np.unique(masks[masks > 0])
        for axis in (1, 2)
        for upwards in (False, True)
        if (one := _hiding(masks, int(i), axis, upwards)) is not None
    ]
    return tuple(box for _, box in sorted(found, key=lambda one: -one[0])[:most])


def _hiding(masks: Int[np.ndarray, "frames height width"], i: int, axis: int, upwards: bool) -> tuple[int, Box] | None:
    """(frames, rectangle) beyond one side of a mask along an axis of ``masks``, or None where that side is cut nowhere."""
    # Seen so that the border is a row and the mask lies below it.
    turned = masks if axis == 1 else masks.transpose(0, 2, 1)
    turned = turned[:, ::-1] if upwards else turned
    told = _cut(turned, i)
    if told is None:
        return None
    frames, row, low, high, extent = told
    empty = np.asarray(turned.max(0) == 0)
    span = _unseen(empty, row, low, high)
    if span is None:
        return None
    top, low, high = _grown(empty, row, *span, extent)
    height = turned.shape[1]
    first, last = (height - row, height - top) if upwards else (top, row)
    box = (low, first, high, last) if axis == 1 else (first, low, last, high)
    return frames, Box(*(float(v) for v in box))


def _cut(masks: Int[np.ndarray, "frames height width"], i: int) -> tuple[int, int, int, int, int] | None:
    """(frames, row, first and last column, extent down) of the row at which a mask's upper side stands still, or None."""
    edges = [_edge(frame, i) for frame in masks]
    there = [edge for edge in edges if edge is not None]
    best: list[_Edge] = []
    for row in {edge.at for edge in there}:
        near = [edge for edge in there if abs(edge.at - row) <= 1]
        if len(near) > len(best) and _moves(near):
            best = near
    if len(best) < FRAMES:
        return None
    rows = [np.nonzero((frame == i).any(1))[0] for frame in masks]
    extent = max(int(r[-1] - r[0]) + 1 for r in rows if len(r))
    row = int(np.median([edge.at for edge in best]))
    return len(best), row, min(edge.low for edge in best), max(edge.high for edge in best) + 1, extent


def _moves(edges: list[_Edge]) -> bool:
    """Whether something moves across the line that these share."""
    return max(np.ptp([edge.opposite for edge in edges]), np.ptp([edge.middle for edge in edges])) > MOVES


def _edge(frame: Int[np.ndarray, "height width"], i: int) -> _Edge | None:
    """The upper side of a mask, or None where it is not flat, at the border, or beside another mask."""
    mask = frame == i
    rows = np.nonzero(mask.any(1))[0]
    if not len(rows) or rows[0] < 2 or mask.sum() < LEAST_PIXELS:
        return None
    columns = np.nonzero(mask.any(0))[0]
    # Borders are noisy: of three rows the one where most of the mask lies.
    upper = mask[rows[0] : rows[0] + 3]
    deep = int(np.argmax(upper.sum(1) > 0.5 * upper.sum(1).max()))
    flat = np.nonzero(upper[deep])[0]
    if len(flat) < max(LEAST, FLAT * len(columns)):
        return None
    above = frame[max(rows[0] - 3, 0) : rows[0] + deep, flat[0] : flat[-1] + 1]
    if ((above > 0) & (above != i)).any():
        return None
    middle = float((mask.sum(1) * np.arange(len(mask))).sum() / mask.sum())
    return _Edge(int(rows[0] + deep), int(flat[0]), int(flat[-1]), int(rows[-1]), middle)


def _unseen(empty: Bool[np.ndarray, "height width"], row: int, low: int, high: int) -> tuple[int, int] | None:
    """(first column, column after the last) of the longest part of a border beyond which nothing is ever seen; None where that is
    not most of it: what hides may end there."""
    beyond = empty[max(row - DEEP, 0) : row, low:high]
    if len(beyond) < DEEP:
        return None
    ends = np.flatnonzero(np.diff(np.concatenate([[0], beyond.all(0).astype(np.int8), [0]])))
    runs = [(int(a), int(b)) for a, b in zip(ends[::2], ends[1::2], strict=True)]
    first, last = max(runs, key=lambda run: run[1] - run[0], default=(0, 0))
    return (low + first, low + last) if last - first >= MOST_OF * (high - low) else None


def _grown(empty: Bool[np.ndarray, "height width"], row: int, low: int, high: int, extent: int) -> tuple[int, int, int]:
    """(top row, first column, column after the last) of a rectangle above ``row``, as wide as nothing is ever seen in it."""
    top = row
    while top > max(row - extent, 0) and empty[top - 1, low:high].all():
        top -= 1
    # The rows next to the border hold its noise.
    inside = empty[top : max(row - 1, top + 1)]
    first, last = low, high
    while first > max(low - extent, 0) and inside[:, first - 1].all():
        first -= 1
    while last < min(high + extent, empty.shape[1]) and inside[:, last].all():
        last += 1
    return top, first, last
