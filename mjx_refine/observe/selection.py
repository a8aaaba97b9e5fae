"""Which tracks are objects: not hands at the border, shadows, flicker, reflections or overlays."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from mjx_refine.observe.foreground import Blob
from mjx_refine.observe.tracking import Track
from mjx_refine.observe.untyped import ndimage

_ON_THE_SPOT = "changing on the spot without moving, like a reflection, a clock or flicker"


def travelled(track: Track) -> float:
    """Greatest distance between a track's centroids and their first, px."""
    centres = path(track)
    return float(np.hypot(*(centres - centres[0]).T).max())


def path(track: Track) -> Float[np.ndarray, "blobs 2"]:
    """Centroids (x, y) in order of time, px."""
    return np.stack([track.blobs[t].centre for t in sorted(track.blobs)])


def radius(track: Track) -> float:
    """Median equivalent radius, px."""
    return float(np.median([b.radius for b in track.blobs.values()]))


def contrast(track: Track) -> float:
    """Median change against the background, levels."""
    return float(np.median([b.contrast for b in track.blobs.values()]))


def shadow_share(track: Track) -> float:
    """Median share of pixels that a shadow explains."""
    return float(np.median([b.shadow for b in track.blobs.values()]))


def moves_bodily(track: Track, pictures: UInt8[np.ndarray, "frames height width 3"]) -> float:
    """How much better the track's own displacement explains the pictures than standing still does.

    Above 1 the texture travels with the outline, as an object's does; below 1 the outline changes while what it
    shows stays, as with a reflection, a change of light or a growing puddle. NaN where it hardly moves.
    """
    ratios = []
    times = sorted(track.blobs)
    for start in times:
        blob = track.blobs[start]
        later = [t for t in times if t > start and np.hypot(*(track.blobs[t].centre - blob.centre)) > 2]
        if not later or blob.border > 0.02 or track.blobs[later[0]].border > 0.02:
            continue
        ratios.append(_gain(blob, track.blobs[later[0]], pictures[start], pictures[later[0]]))
    return float(np.median(ratios)) if len(ratios) >= 2 else float("nan")


def _gain(blob: Blob, other: Blob, first: np.ndarray, second: np.ndarray) -> float:
    region = ndimage.binary_dilation(np.pad(blob.crop, 2), iterations=2)
    rows, cols = np.nonzero(region)
    rows, cols = rows + blob.top - 2, cols + blob.left - 2
    height, width = first.shape[:2]
    dx, dy = np.rint(other.centre - blob.centre).astype(int)
    here = first[rows.clip(0, height - 1), cols.clip(0, width - 1)].astype(np.float32)

    def misfit(x: int, y: int) -> float:
        seen = second[(rows + y).clip(0, height - 1), (cols + x).clip(0, width - 1)]
        return float(np.abs(seen - here).mean()) + 1.0

    return misfit(0, 0) / min(misfit(dx + x, dy + y) for x in (-1, 0, 1) for y in (-1, 0, 1))


def select_objects(
    tracks: list[Track], pictures: UInt8[np.ndarray, "frames height width 3"]
) -> tuple[list[Track], list[str]]:
    """Keeps the tracks that are objects, most important first, and says in sentences what was left out and why."""
    frames = len(pictures)
    dropped: dict[str, list[Track]] = {}
    kept = []
    for track in tracks:
        reason = _own_reason(track, frames) or _unmoved(track, pictures)
        if reason is None:
            kept.append(track)
        else:
            dropped.setdefault(reason, []).append(track)
    for reason, losers in _compare(kept):
        dropped.setdefault(reason, []).extend(losers)
        kept = [k for k in kept if all(k is not loser for loser in losers)]
    kept.sort(key=_weight, reverse=True)
    return kept, [_sentence(reason, losers) for reason, losers in dropped.items() if _worth_saying(losers, kept)]


def _weight(track: Track) -> float:
    return len(track.blobs) * radius(track) * min(contrast(track), 60)


def _worth_saying(losers: list[Track], kept: list[Track]) -> bool:
    return any(len(k.blobs) >= 3 for k in losers) or not kept


def _sentence(reason: str, losers: list[Track]) -> str:
    count = len(losers)
    where = max(losers, key=_weight)
    x, y = path(where)[0]
    first, last = min(where.blobs), max(where.blobs)
    return (
        f"{count} moving region{'s' if count > 1 else ''} left out: {reason}"
        f" (the largest near x {x:.0f}, y {y:.0f} px, frames {first}-{last})"
    )


def _own_reason(track: Track, frames: int) -> str | None:
    life = len(track.blobs)
    if life < max(2, min(3, frames // 2), round(0.12 * frames)):
        return "seen in few frames only"
    if life < 0.6 * frames and not (
        _entered(track, min(track.blobs), 0) and _entered(track, max(track.blobs), frames - 1)
    ):
        return "appearing or disappearing inside the picture, like a reflection"
    touching = np.mean([b.border > 0.03 for b in track.blobs.values()])
    if touching > 0.8:
        return "at the picture's border all the time, like a hand or a frame around the picture"
    areas = np.array([b.area for b in track.blobs.values() if b.border < 0.02], float)
    if travelled(track) < 1.0 and (radius(track) < 4 or contrast(track) < 25):
        return _ON_THE_SPOT
    steps = np.hypot(*np.diff(path(track), axis=0).T)
    if travelled(track) < 3 * radius(track) + 2 and steps.sum() > 3.5 * travelled(track):
        return _ON_THE_SPOT
    if len(steps) > 3 and np.median(steps) > 1.5:
        turns = np.hypot(*np.diff(path(track), n=2, axis=0).T)
        if np.median(turns) > 1.3 * np.median(steps):  # hops to and fro, where a body would go on
            return _ON_THE_SPOT
    still = travelled(track) < max(2.0, 0.25 * radius(track))
    if still and (life < 0.7 * frames or (len(areas) > 2 and areas.std() / areas.mean() > 0.3)):
        return _ON_THE_SPOT
    return None


def _entered(track: Track, t: int, limit: int) -> bool:
    """Whether the track's end at frame ``t`` is the clip's (``limit``) or lies at the picture's border."""
    return t == limit or track.blobs[t].border > 0 or track.at_border(t)


def _unmoved(track: Track, pictures: UInt8[np.ndarray, "frames height width 3"]) -> str | None:
    return _ON_THE_SPOT if moves_bodily(track, pictures) < 1.0 else None


def _compare(tracks: list[Track]) -> list[tuple[str, list[Track]]]:
    """Tracks that fall short beside another one."""
    if len(tracks) < 2:
        return []
    clear = [k for k in tracks if shadow_share(k) < 0.4]
    shadows = [
        k
        for k in tracks
        if (
            any(
                _follows(k, other) and shadow_share(k) > shadow_share(other) + 0.1 for other in tracks if other is not k
            )
            and shadow_share(k) > 0.45
        )
        or (clear and shadow_share(k) > 0.6)
    ]
    rest = [k for k in tracks if all(k is not s for s in shadows)]
    if not rest:
        return []
    strongest = max(_weight(k) for k in rest)
    top = max(contrast(k) for k in rest)
    faint = [
        k
        for k in rest
        if _weight(k) < 0.05 * strongest
        or (contrast(k) < 0.3 * top and contrast(k) < 40 and _weight(k) < 0.4 * strongest)
    ]
    return (
        [
            ("darker copies of the background, like shadows", shadows),
            ("faint or tiny beside the objects, like reflections", faint),
        ]
        if shadows and faint
        else (
            [("darker copies of the background, like shadows", shadows)]
            if shadows
            else ([("faint or tiny beside the objects, like reflections", faint)] if faint else [])
        )
    )


def _follows(track: Track, other: Track) -> bool:
    """Whether ``track`` moves as ``other`` does, as a shadow follows its object."""
    common = sorted(set(track.blobs) & set(other.blobs))
    if len(common) < 3 or len(common) < 0.6 * len(track.blobs):
        return False
    mine = np.stack([track.blobs[t].centre for t in common])
    theirs = np.stack([other.blobs[t].centre for t in common])
    moved = np.abs(np.diff(theirs, axis=0)).sum()
    return moved > 3 and np.abs(np.diff(mine - theirs, axis=0)).sum() < 0.6 * moved
