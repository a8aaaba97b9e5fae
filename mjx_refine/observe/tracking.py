"""Which blob is which object, from frame to frame, through touching and short disappearances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

from mjx_refine.observe.foreground import Blob, Change, make_blob
from mjx_refine.observe.untyped import ndimage

_PATIENCE = 6  # frames that a track waits for its object to come back
_WORST_COST = 2.2


@dataclass
class Track:
    """One object's blobs by frame, and how it moved last."""

    blobs: dict[int, Blob] = field(default_factory=dict)
    shared: set[int] = field(default_factory=set)

    def latest(self, t: int, step: int) -> tuple[int, Blob]:
        """The last frame before ``t`` (in the direction ``step``) with a blob."""
        frames = [f for f in self.blobs if (t - f) * step > 0]
        frame = max(frames, key=lambda f: f * step)
        return frame, self.blobs[frame]

    def velocity(self, t: int, step: int) -> Float[np.ndarray, " 2"]:
        """Pixels per frame in the direction of tracking, from the last two or three blobs."""
        frames = sorted((f for f in self.blobs if (t - f) * step > 0), key=lambda f: -f * step)[:3]
        if len(frames) < 2:
            return np.zeros(2)
        moved = self.blobs[frames[0]].centre - self.blobs[frames[-1]].centre
        return moved / abs(frames[0] - frames[-1])

    def predict(self, t: int, step: int) -> Float[np.ndarray, " 2"]:
        frame, blob = self.latest(t, step)
        return blob.centre + self.velocity(t, step) * abs(t - frame)

    def at_border(self, t: int) -> bool:
        """Whether the blob at frame ``t`` is within one step of the picture's border."""
        blob = self.blobs[t]
        others = sorted(self.blobs, key=lambda f: abs(f - t))[1:2]
        step = float(np.abs(self.blobs[others[0]].centre - blob.centre).max()) if others else 0.0
        return blob.margin <= 2 + 1.5 * step

    def template(self, t: int, step: int) -> Blob:
        """The last outline that was not cut out of a shared region, else the last one."""
        frames = sorted((f for f in self.blobs if (t - f) * step > 0), key=lambda f: -f * step)
        whole = [f for f in frames[:8] if f not in self.shared and self.blobs[f].border < 0.05]
        return self.blobs[(whole or frames)[0]]


def track_blobs(blobs: list[list[Blob]], shape: tuple[int, int], change_at: Callable[[int], Change]) -> list[Track]:
    """Links blobs into tracks, from the frame where most objects stand apart to both ends of the clip.

    Args:
      blobs: each frame's blobs.
      shape: (height, width), px.
      change_at: a frame's comparison with the background, to cut regions that objects share.

    Returns:
      The tracks, each with at most one blob a frame. A blob in which several tracks meet is cut by their last
      separate outlines and colours.
    """
    if not any(blobs):
        return []
    seed = _seed(blobs)
    tracks = [Track({seed: b}) for b in blobs[seed]]
    for step in (1, -1):
        t = seed + step
        while 0 <= t < len(blobs):
            _advance(tracks, blobs[t], t, step, shape, change_at)
            t += step
    return _link(tracks, float(np.hypot(*shape)))


def _link(tracks: list[Track], diagonal: float) -> list[Track]:
    """Joins tracks that end and begin alike within a few frames: one object after a sharp turn or a short gap."""
    tracks = list(tracks)
    while True:
        pairs = [
            (_link_cost(a, b, diagonal), i, j)
            for i, a in enumerate(tracks)
            for j, b in enumerate(tracks)
            if 0 < min(b.blobs) - max(a.blobs) <= _PATIENCE
        ]
        best = min(pairs, default=(np.inf, 0, 0))
        if best[0] >= 1:
            return tracks
        _, i, j = best
        joined = Track({**tracks[i].blobs, **tracks[j].blobs}, tracks[i].shared | tracks[j].shared)
        tracks = [k for n, k in enumerate(tracks) if n not in (i, j)] + [joined]


def _link_cost(early: Track, late: Track, diagonal: float) -> float:
    """Below 1 where two tracks can be one object's; the ends must look alike and be where either leads."""
    end, start = max(early.blobs), min(late.blobs)
    a, b = early.blobs[end], late.blobs[start]
    colour = float(np.abs(a.colour - b.colour).max()) / 45
    size = 0.0 if max(a.border, b.border) > 0.02 else abs(float(np.log(a.area / b.area))) / 0.7
    speed = max(float(np.hypot(*early.velocity(start, 1))), float(np.hypot(*late.velocity(end, -1))))
    ahead = np.hypot(*(early.predict(start, 1) - b.centre))
    behind = np.hypot(*(late.predict(end, -1) - a.centre))
    distance = min(ahead, behind) / (max(3 * a.radius, 0.06 * diagonal) + speed)
    shadow = abs(a.shadow - b.shadow) / 0.6
    worst = max(colour, size, float(distance), shadow)
    return worst if worst < 1 else np.inf


def _seed(blobs: list[list[Blob]]) -> int:
    scores = []
    for t, here in enumerate(blobs):
        near = [b for s in (t - 1, t + 1) if 0 <= s < len(blobs) for b in blobs[s]]
        lasting = [b for b in here if b.border < 0.05 and (len(blobs) == 1 or any(_alike(b, n) for n in near))]
        scores.append(sum(np.sqrt(b.area) * min(b.contrast, 60) for b in lasting))
    # Among equals, the middle of the clip: both passes are then short.
    best = max(scores)
    good = [t for t, s in enumerate(scores) if s >= 0.97 * best]
    return min(good, key=lambda t: abs(t - len(blobs) / 2))


def _alike(a: Blob, b: Blob) -> bool:
    return 0.6 < a.area / b.area < 1.65 and float(np.hypot(*(a.centre - b.centre))) < 4 * a.radius + 8


def _cost(track: Track, blob: Blob, t: int, step: int, diagonal: float) -> float:
    frame, last = track.latest(t, step)
    gap = abs(t - frame)
    speed = float(np.hypot(*track.velocity(t, step)))
    reach = max(2.5 * last.radius, 0.05 * diagonal) + 1.5 * speed
    if len(track.blobs) == 1:
        reach = max(reach, 0.12 * diagonal)
    predicted = float(np.hypot(*(blob.centre - track.predict(t, step))))
    stayed = float(np.hypot(*(blob.centre - last.centre)))
    # After a bounce the prediction is wrong, but the object is still near where it was.
    distance = min(predicted, 1.0 + 1.1 * stayed) / (reach * (1 + 0.25 * (gap - 1)))
    if distance > 1:
        return np.inf
    size = abs(float(np.log(blob.area / track.template(t, step).area)))
    if blob.border > 0.02 or last.border > 0.02:
        size *= 0.3
    colour = float(np.abs(blob.colour - last.colour).max()) / 60
    return 1.5 * distance + 0.6 * size + 0.5 * colour


def _advance(
    tracks: list[Track],
    blobs: list[Blob],
    t: int,
    step: int,
    shape: tuple[int, int],
    change_at: Callable[[int], Change],
) -> None:
    active = [k for k in tracks if any(0 < (t - f) * step <= _PATIENCE for f in k.blobs) and t not in k.blobs]
    diagonal = float(np.hypot(*shape))
    owners: dict[int, list[Track]] = {j: [] for j in range(len(blobs))}
    if active and blobs:
        cost = np.array([[_cost(k, b, t, step, diagonal) for b in blobs] for k in active])
        bounded = np.where(np.isfinite(cost) & (cost < _WORST_COST), cost, 1e3)
        for i, j in zip(*linear_sum_assignment(bounded), strict=True):
            if bounded[i, j] < 1e3:
                owners[j].append(active[i])
    _share(active, blobs, owners, t, step, shape)
    for j, blob in enumerate(blobs):
        if len(owners[j]) == 1:
            owners[j][0].blobs[t] = blob
        elif len(owners[j]) > 1:
            for track, part in zip(owners[j], _cut(owners[j], blob, t, step, shape, change_at(t)), strict=True):
                if part is not None:
                    track.blobs[t] = part
                    track.shared.add(t)
        elif not _fragment(blob, tracks, t, shape, change_at):
            tracks.append(Track({t: blob}))


def _share(
    active: list[Track],
    blobs: list[Blob],
    owners: dict[int, list[Track]],
    t: int,
    step: int,
    shape: tuple[int, int],
) -> None:
    """Adds tracks that found no blob of their own to the owners of a bigger blob that covers their place."""
    taken = [k for ks in owners.values() for k in ks]
    for track in (k for k in active if all(k is not other for other in taken)):
        template = track.template(t, step)
        place = _shifted(template, track.predict(t, step), shape)
        frame, last = track.latest(t, step)
        if abs(t - frame) > 3:
            continue
        best, best_cover = None, 0.35
        for j, blob in enumerate(blobs):
            others = sum(k.template(t, step).area for k in owners[j])
            if not owners[j] or blob.area < max(1.15 * others, others + 0.3 * template.area):
                continue
            cover = max(_cover(blob, place, shape), _cover(blob, _shifted(template, last.centre, shape), shape))
            both = others + template.area
            near = float(np.hypot(*(blob.centre - track.predict(t, step)))) < 1.2 * (blob.radius + last.radius)
            if near and 0.75 * both < blob.area < 1.3 * both:
                cover = max(cover, 0.4)  # it has about the size of all of them together, and is where this one can be
            if cover > best_cover:
                best, best_cover = j, cover
        if best is not None:
            owners[best].append(track)


def _cover(blob: Blob, place: Bool[np.ndarray, "height width"], shape: tuple[int, int]) -> float:
    count = np.count_nonzero(place)
    return np.count_nonzero(place & blob.paint(shape)) / count if count else 0.0


def _shifted(blob: Blob, centre: Float[np.ndarray, " 2"], shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """The blob's outline moved so that its centroid is at ``centre``, cut at the picture's border."""
    dx, dy = np.rint(centre - blob.centre).astype(int)
    rows, cols = np.nonzero(blob.crop)
    rows, cols = rows + blob.top + dy, cols + blob.left + dx
    inside = (rows >= 0) & (rows < shape[0]) & (cols >= 0) & (cols < shape[1])
    full = np.zeros(shape, bool)
    full[rows[inside], cols[inside]] = True
    return full


def _cut(
    owners: list[Track], blob: Blob, t: int, step: int, shape: tuple[int, int], change: Change
) -> list[Blob | None]:
    """Cuts a shared region: each pixel goes to the track into whose outline it fits deepest, helped by colour.

    The outlines' places are found by turns, as in k-means: assign pixels, move each outline to its pixels.
    """
    region = blob.paint(shape)
    rows, cols = np.nonzero(region)
    colours = change.even[rows, cols]
    templates = [k.template(t, step) for k in owners]
    centres = _spread([k.predict(t, step) for k in owners], templates, rows, cols)
    hues = np.stack([b.colour for b in templates])
    apart = np.abs(hues[:, None] - hues[None]).max(-1).max()
    weight = min(1.0, max(0.0, (apart - 25) / 50)) / 12  # px of depth per level of colour distance
    shades = np.stack([np.abs(colours - h).max(-1) for h in hues])
    nearest = np.zeros(len(rows), int)
    for _ in range(10):
        depth = np.stack([_depth(b, c, shape)[rows, cols] for b, c in zip(templates, centres, strict=True)])
        updated = (depth - weight * shades).argmax(0)
        moved = []
        for i, (template, centre) in enumerate(zip(templates, centres, strict=True)):
            mine = updated == i
            if np.count_nonzero(mine) < 3:
                moved.append(centre)
                continue
            pull = np.array([cols[mine].mean() + 0.5, rows[mine].mean() + 0.5]) - centre
            share = min(1.0, np.count_nonzero(mine) / template.area)  # a part says less about where the whole is
            moved.append(centre + pull * share)
        if np.array_equal(updated, nearest) and np.allclose(moved, centres, atol=0.05):
            break
        nearest, centres = updated, moved
    parts: list[Blob | None] = []
    for i in range(len(owners)):
        mine = np.zeros(shape, bool)
        mine[rows[nearest == i], cols[nearest == i]] = True
        labels, count = ndimage.label(mine)
        if count > 1:
            sizes = ndimage.sum_labels(mine, labels, np.arange(1, count + 1))
            mine = labels == 1 + int(np.argmax(sizes))
        parts.append(make_blob(mine, change, (slice(0, shape[0]), slice(0, shape[1]))) if mine.sum() >= 4 else None)
    return parts


def _spread(
    centres: list[Float[np.ndarray, " 2"]], templates: list[Blob], rows: np.ndarray, cols: np.ndarray
) -> list[Float[np.ndarray, " 2"]]:
    """Moves the predicted places together so that their area-weighted mean is the region's centroid."""
    areas = np.array([b.area for b in templates], float)
    mean = (np.stack(centres) * areas[:, None]).sum(0) / areas.sum()
    shift = np.array([cols.mean() + 0.5, rows.mean() + 0.5]) - mean
    return [c + shift for c in centres]


def _depth(blob: Blob, centre: Float[np.ndarray, " 2"], shape: tuple[int, int]) -> Float[np.ndarray, "height width"]:
    """Signed distance to the outline of ``blob`` moved to ``centre`` (subpixel), positive inside, px."""
    pad = 3
    crop = np.pad(blob.crop, pad)
    inside, outside = ndimage.distance_transform_edt(crop), ndimage.distance_transform_edt(~crop)
    signed = (inside - outside).astype(np.float32)
    offset = centre - blob.centre + np.array([blob.left, blob.top]) - pad
    ys, xs = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    r, c = ys - offset[1], xs - offset[0]
    h, w = crop.shape
    beyond = np.hypot(np.maximum(np.maximum(-r, r - (h - 1)), 0), np.maximum(np.maximum(-c, c - (w - 1)), 0))
    values = ndimage.map_coordinates(signed, [np.clip(r, 0, h - 1), np.clip(c, 0, w - 1)], order=1)
    return values - beyond


def _fragment(
    blob: Blob,
    tracks: list[Track],
    t: int,
    shape: tuple[int, int],
    change_at: Callable[[int], Change],
) -> bool:
    """Joins a small unclaimed blob to the track of which it is a broken-off piece; False if it is none."""
    for track in tracks:
        mine = track.blobs.get(t)
        if mine is None or blob.area > 0.6 * mine.area:
            continue
        neighbours = [track.blobs[f] for f in (t - 1, t + 1) if f in track.blobs]
        if not neighbours or mine.area > 0.9 * neighbours[0].area:
            continue
        place = _shifted(neighbours[0], mine.centre, shape) | _shifted(
            neighbours[0], (mine.centre * mine.area + blob.centre * blob.area) / (mine.area + blob.area), shape
        )
        painted = blob.paint(shape)
        if np.count_nonzero(painted & place) > 0.7 * blob.area:
            whole = ndimage.binary_closing(painted | mine.paint(shape), np.ones((3, 3), bool), iterations=2)
            joined = make_blob(
                whole | painted | mine.paint(shape), change_at(t), (slice(0, shape[0]), slice(0, shape[1]))
            )
            if joined is not None:
                track.blobs[t] = joined
            return True
    return False
