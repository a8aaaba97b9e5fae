"""What a clip says about each object before any physics: where it was, how it was cut into smooth pieces, how wide it is."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.search.features import DIRECTIONS, MIN_PIXELS, Outlines, outlines
from mjx_refine.view.tiles import foreground

MAX_OBJECTS = 6
"""Moving regions that are followed where there are no masks."""

SMOOTH = 1.5
"""Distance from a parabola's prediction [px at a picture 480 wide] beyond which a new piece begins."""


@dataclasses.dataclass(frozen=True)
class Piece:
    """Frames in which a track is a parabola: c(t) = start + velocity t + acceleration t^2 / 2, t in frames from the clip's start.

    Attributes:
      frames: of the piece, ascending.
      start, velocity, acceleration: [px, px/frame, px/frame^2].
    """

    frames: Int[np.ndarray, "piece"]
    start: Float[np.ndarray, "2"]
    velocity: Float[np.ndarray, "2"]
    acceleration: Float[np.ndarray, "2"]

    def at(self, t: float) -> np.ndarray:
        """Centre at frame ``t`` [px]."""
        return self.start + self.velocity * t + self.acceleration * (t * t / 2)

    def speed(self, t: float) -> np.ndarray:
        """Velocity at frame ``t`` [px/frame]."""
        return self.velocity + self.acceleration * t


@dataclasses.dataclass(frozen=True)
class Track:
    """One object in the picture.

    Attributes:
      id: of its mask.
      seen: frames with a mask.
      whole: frames whose mask nothing cuts.
      centre: middle of the outline, NaN where it was not seen [px].
      support: how far the outline reaches in 16 directions [px].
      width: mean width of the outline by frame, NaN where it is cut [px].
      widths: of the outline in the first 8 directions, near the first frame [px].
      area: near the first frame [px^2].
      pieces: smooth pieces of the track, in order.
      spin: turn in the picture near the first frame, anticlockwise as seen [rad/frame].
      late: whether it was at rest before it was first seen (only where there are no masks).
    """

    id: int
    seen: Bool[np.ndarray, "frames"]
    whole: Bool[np.ndarray, "frames"]
    centre: Float[np.ndarray, "frames 2"]
    support: Float[np.ndarray, "frames directions"]
    width: Float[np.ndarray, "frames"]
    widths: Float[np.ndarray, "8"]
    area: float
    pieces: tuple[Piece, ...]
    spin: float
    late: bool = False

    @property
    def roundness(self) -> float:
        """Narrowest over widest, 1 for a disc."""
        return float(self.widths.min() / max(self.widths.max(), 1e-9))

    @property
    def diameter(self) -> float:
        """Of the disc of the same area [px]."""
        return float(2 * np.sqrt(self.area / np.pi))


def find_tracks(observation: Observation) -> tuple[list[Track], Outlines]:
    """Every object's track, and the outlines they come from.

    Raises:
      InputError: nothing moves and there are no masks, or all masks are tiny.
    """
    no_masks = observation.masks is None
    masks = moving_objects(observation) if no_masks else foreground(observation)
    seen = outlines(masks)
    tracks = []
    for column in range(len(seen.ids)):
        if np.isfinite(seen.centre[:, column, 0]).any():
            tracks.append(_track(observation, masks, seen, column, no_masks))
    if not tracks:
        raise InputError(
            f"{observation.source}: no object was found (no masks, and no region of at least {MIN_PIXELS} pixels moves); "
            "expected something that moves; give masks, or see `refine observe`"
        )
    return tracks, seen


def moving_objects(observation: Observation) -> Int[np.ndarray, "frames height width"]:
    """Instance ids of moving regions, followed from frame to frame by the nearest predicted place."""
    moving = foreground(observation) > 0
    result = np.zeros(moving.shape, np.int32)
    last: dict[int, tuple[int, np.ndarray, np.ndarray, float]] = {}
    for t, frame in enumerate(moving):
        labels = np.asarray(ndimage.label(ndimage.binary_opening(frame, iterations=1))[0])  # type: ignore[index]
        areas = np.bincount(labels.ravel())[1:]
        order = [
            i for i in np.argsort(-areas, kind="stable") if areas[i] >= max(MIN_PIXELS, 0.03 * areas.max(initial=0))
        ]
        free = set(last)
        for i in order[:MAX_OBJECTS]:
            centre = np.array(ndimage.center_of_mass(labels == i + 1))[::-1]
            flow = np.nan_to_num(np.nanmedian(observation.flow[t][labels == i + 1], axis=0))
            reach = 1.5 * np.sqrt(areas[i])
            away = {k: np.linalg.norm(last[k][1] + last[k][2] * (t - last[k][0]) - centre) for k in free}
            best = min(away, key=lambda k: away[k], default=None)
            if best is None or away[best] > reach + 2 * np.linalg.norm(flow):
                best = len(last) + 1
            free.discard(best)
            last[best] = (t, centre, flow, float(areas[i]))
            result[t][labels == i + 1] = best
    present = np.array([(result == k).any((1, 2)).sum() for k in range(1, len(last) + 1)])
    enough = np.argsort(-present, kind="stable")[:MAX_OBJECTS]
    keep = {int(k) + 1 for k in enough if present[k] >= max(min(3, len(moving) - 1), 0.15 * present.max())}
    return np.where(np.isin(result, list(keep)), result, 0)


def _track(observation: Observation, masks: np.ndarray, seen: Outlines, column: int, no_masks: bool) -> Track:
    support = seen.support[:, column]
    half = DIRECTIONS // 2
    whole = np.asarray(np.isfinite(support).all(-1))
    visible = np.isfinite(seen.centre[:, column, 0])
    # Opposite edges that are both known give the middle even where another edge is cut.
    quarter = DIRECTIONS // 4
    middle = np.stack(
        [(support[:, 0] - support[:, half]) / 2, (support[:, quarter] - support[:, quarter + half]) / 2], -1
    )
    centre = np.where(np.isfinite(middle), middle, seen.centre[:, column])
    centre[whole] = 0.5 * (middle[whole] + seen.centre[whole, column])
    usable = whole if whole.sum() >= 2 else visible
    frames = np.nonzero(usable)[0]
    across = support[:, :half] + support[:, half:]
    first = frames[:3]
    area = float(np.median(seen.area[first, column]))
    widths = np.median(across[first], axis=0) if whole.any() else np.full(half, np.nan)
    widths = np.where(np.isfinite(widths), widths, 2 * np.sqrt(max(area, 1.0) / np.pi))
    pixel = observation.size[0] / 480.0
    pieces = cut(frames, centre[frames], SMOOTH * max(pixel, 0.5) + 0.06 * float(widths.mean()))
    late = no_masks and frames[0] > 1 and _inside(centre[frames[0]], widths.mean(), observation.size)
    return Track(
        id=seen.ids[column],
        seen=visible,
        whole=whole,
        centre=np.where(visible[:, None], centre, np.nan),
        support=support,
        width=np.where(whole, across.mean(-1), np.nan),
        widths=widths,
        area=area,
        pieces=pieces,
        spin=_spin(observation, masks, seen.ids[column], pieces[0].frames),
        late=bool(late),
    )


def _inside(centre: np.ndarray, width: float, size: tuple[int, int]) -> bool:
    return bool((centre > 1.5 * width).all() and (centre < np.array(size) - 1.5 * width).all())


def cut(frames: np.ndarray, centre: np.ndarray, tolerance: float) -> tuple[Piece, ...]:
    """Cuts a track where a parabola through what came before misses the next two points by more than ``tolerance``."""
    pieces, begin = [], 0
    while begin < len(frames):
        end = min(begin + 3, len(frames))
        while end < len(frames):
            piece = _fit(frames[begin:end], centre[begin:end])
            ahead = range(end, min(end + 2, len(frames)))
            # A parabola through few points predicts badly; a straight line is allowed as well.
            line = _fit(frames[begin:end], centre[begin:end], degree=1)
            missed = [
                min(np.linalg.norm(p.at(frames[k]) - centre[k]) for p in (piece, line)) > tolerance * (1 + k - end)
                for k in ahead
            ]
            if all(missed):
                break
            end += 1
        pieces.append(_fit(frames[begin:end], centre[begin:end]))
        begin = end
    return tuple(pieces)


def _fit(frames: np.ndarray, centre: np.ndarray, degree: int = 2) -> Piece:
    degree = min(degree, len(frames) - 1 if len(frames) < 4 else 2)
    origin = float(frames.mean())
    powers = np.stack([(frames - origin) ** k / (1, 1, 2)[k] for k in range(degree + 1)], -1)
    solution = np.zeros((3, 2))
    solution[: degree + 1] = np.linalg.lstsq(powers, centre, rcond=None)[0]
    place, speed, change = solution
    start = place - speed * origin + change * origin**2 / 2
    return Piece(frames, start, speed - change * origin, change)


def _spin(observation: Observation, masks: np.ndarray, i: int, frames: np.ndarray) -> float:
    """Median over a few frames of the flow's rotation about the mask's middle."""
    turns = []
    for t in frames[:6]:
        if t >= len(observation.flow):
            continue
        rows, columns = np.nonzero(masks[t] == i)
        flow = observation.flow[t][rows, columns].astype(np.float64)
        good = np.isfinite(flow).all(-1)
        if good.sum() < MIN_PIXELS:
            continue
        x, y = columns[good] - columns[good].mean(), rows[good] - rows[good].mean()
        u, v = (flow[good] - flow[good].mean(0)).T
        turns.append(float((u * y - v * x).sum() / max((x * x + y * y).sum(), 1e-9)))
    return float(np.median(turns)) if turns else 0.0
