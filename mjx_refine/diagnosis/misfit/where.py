"""Where simulation and clip part: objects, frames, phases and channels of the misfit above the noise."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.result import CHANNELS, Place
from mjx_refine.diagnosis.seen.common_motion import of_background
from mjx_refine.diagnosis.seen.noise import BACKGROUND_COUNT
from mjx_refine.effects.kind import FitView
from mjx_refine.search.features import DIRECTIONS
from mjx_refine.view.outline import directions

LOUD = 2.0
"""Mean square residual [noise widths squared] from which a frame counts as misfitting."""


def misfit_map(
    clip: ClipFit, fit: Fit
) -> tuple[Float[np.ndarray, "objects frames"], Int[np.ndarray, "objects frames"], Float[np.ndarray, "frames"]]:
    """(mean square misfit by object and frame, its channel, the background's mean square misfit)."""
    parts = clip.measured.split(fit.residual)
    seen = np.isfinite(clip.measured.reach).mean(-1) > 0
    placed = np.isfinite(clip.measured.moments).all(-1)
    still = (parts.reach**2).sum(-1) + (parts.moments**2).sum(-1)
    still = still / (clip.counts.edge + 3.0 * placed)
    moved = np.zeros_like(still)
    moved[:-1] = (parts.flow**2).sum((-1, -2)) / (2 * clip.counts.flow)
    total = np.where(seen, 0.6 * still + 0.4 * moved, 0.0)
    return total.T, _channels(parts.reach, moved).T, background_energy(clip, fit)


def background_energy(clip: ClipFit, fit: Fit) -> Float[np.ndarray, "frames"]:
    """Mean square of what the background's flow leaves in common, by frame [noise widths squared]; zero where a clip has none
    (poses).

    What a camera does moves the whole picture: its residual is, in every frame, a shift, a turn and a stretch of all places
    together. What flow invents beside a moving object, in shadows and where nothing has texture, is not.
    """
    shared = of_background(clip.measured, clip.measured.split(fit.residual).background)
    return np.append(shared / (2 * BACKGROUND_COUNT), 0.0)


def _channels(reach: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Which harmonic of the outline's residual is the largest: a shift is motion, an even one shape, the rest rotation."""
    normals = directions(DIRECTIONS)
    norm = np.sqrt(DIRECTIONS)
    even = (reach.sum(-1) / norm) ** 2
    shift = ((reach @ normals) ** 2).sum(-1) * 2 / DIRECTIONS
    rest = np.maximum((reach**2).sum(-1) - even - shift, 0.0)
    energies = np.stack([shift, rest / 3, even], -1)
    return np.array([CHANNELS.index(c) for c in ("motion", "rotation", "shape")])[energies.argmax(-1)]


def places(clip: ClipFit, base: Fit, best: Fit | None, view: FitView) -> tuple[Place, ...]:
    """Where the gap is.

    Args:
      clip: residuals.
      base: the base model's fit.
      best: the fit with the verdict's effects, which say where they act; None where there are none.
      view: of the fit that says it (``best`` or ``base``).
    """
    after = None if best is None else misfit_map(clip, best)[0]
    return places_of(misfit_map(clip, base), after, base, best, view)


def places_of(
    before: tuple[np.ndarray, np.ndarray, np.ndarray],
    after: np.ndarray | None,
    base: Fit,
    best: Fit | None,
    view: FitView,
) -> tuple[Place, ...]:
    """Where the gap is, from maps as ``misfit_map`` makes them; ``after``: of ``best``, the first of the three."""
    energy, channel, beside = before
    excess = np.maximum(_smooth(energy) - 1.0, 0.0)
    extra = np.maximum(beside - 1.0, 0.0)
    total = float(excess.sum() + extra.sum())
    names = base.hypothesis.space.scene.names
    found: list[Place] = []
    if best is not None and after is not None:
        left = np.maximum(_smooth(after) - 1.0, 0.0)
        gained = float(np.maximum(excess - left, 0.0).sum()) + float(extra.sum())
        share = min(0.99, gained / total) if total > 0 else 0.0
        found = _acting(best, view, names, channel, excess, share)
    used = sum(p.share for p in found)
    for n, name in enumerate(names):
        for first, last in _loud(excess[n]):
            part = float(excess[n, first : last + 1].sum()) / total if total > 0 else 0.0
            part *= 1.0 - used
            if part >= 0.02:
                kind = CHANNELS[int(np.bincount(channel[n, first : last + 1]).argmax())]
                found.append(Place(name, (first, last), phase_of(view, n, first, last), kind, part))
    if extra.sum() > 0.05 * total and total > 0 and best is None:
        found.append(Place(None, (0, view.frames - 1), "whole", "camera", float(extra.sum()) / total * (1 - used)))
    return tuple(sorted(_merged(found), key=lambda p: -p.share)[:8])


def _merged(found: list[Place]) -> list[Place]:
    """The places, each once: where what acts and what is loud are the same, their shares together."""
    shares: dict[Place, float] = {}
    for place in found:
        alike = dataclasses.replace(place, share=0.0)
        shares[alike] = shares.get(alike, 0.0) + place.share
    return [dataclasses.replace(place, share=share) for place, share in shares.items()]


def _acting(best: Fit, view: FitView, names, channel, excess, share: float) -> list[Place]:
    """One place a term: where and when the effect acts."""
    terms = best.hypothesis.terms
    result = []
    for k, one in enumerate(terms):
        values = best.hypothesis.values(best.z[None], k)[0]
        told = one.kind.window(view, one.target, values)
        if told is None:
            loud = np.nonzero((excess[one.target] if one.target >= 0 else excess.sum(0)) > 0.5)[0]
            told = (int(loud[0]), int(loud[-1])) if len(loud) else (0, view.frames - 1)
        n = one.target if one.target >= 0 else one.kind.struck(view, values)
        phase = phase_of(view, n, *told) if n >= 0 else "whole"
        result.append(Place(names[n] if n >= 0 else None, told, phase, one.kind.channel, share / len(terms)))
    return result


def _smooth(energy: np.ndarray) -> np.ndarray:
    padded = np.pad(energy, ((0, 0), (1, 1)), mode="edge")
    return (padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]) / 3


def _loud(excess: np.ndarray) -> list[tuple[int, int]]:
    """Runs of frames with a clear misfit."""
    loud = np.concatenate([[False], excess > LOUD - 1.0, [False]])
    edges = np.nonzero(np.diff(loud.astype(int)))[0]
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def phase_of(view: FitView, n: int, first: int, last: int) -> str:
    """What the object mostly does in these frames."""
    part = slice(first, last + 1)
    on_floor = view.on_floor[part, n]
    speed = np.linalg.norm(view.velocity[part, n], axis=-1)
    if len(on_floor) == view.frames and 0.2 < on_floor.mean() < 0.8:
        return "whole"
    if on_floor.mean() < 0.5:
        return "flight"
    if last - first <= 2 and len(view.velocity) > last + 1:
        jump = np.linalg.norm(np.diff(view.velocity[max(first - 1, 0) : last + 2, n], axis=0), axis=-1).max(initial=0.0)
        if jump > 0.5:
            return "impact"
    if np.median(speed) < 0.05:
        return "rest"
    lowest = view.batch.size[0, n, 0]
    rolls = view.batch.shapes[n] != "box" and float(
        np.median(np.linalg.norm(view.spin[part, n], axis=-1))
    ) * lowest > 0.5 * float(np.median(speed))
    return "rolling" if rolls else "sliding"


def describe(clip: ClipFit, fit: Fit, view: FitView) -> str:
    """The misfit in plain words: which object, when, which way, how it goes with speed."""
    energy, channel, beside = misfit_map(clip, fit)
    names = fit.hypothesis.space.scene.names
    excess = np.maximum(energy - 1.0, 0.0)
    if excess.mean() < 0.3 and np.maximum(beside - 1, 0).mean() < 0.3:
        return "Nothing above the measurement's noise."
    n = int(excess.sum(1).argmax())
    frames = np.nonzero(excess[n] > 0.5)[0]
    reach = _distances(clip, fit)[:, n]
    shift = np.nan_to_num(reach) @ directions(DIRECTIONS) * 2 / DIRECTIONS
    way = -shift[frames].mean(0) if len(frames) else np.zeros(2)
    size = np.linalg.norm(way)
    compass = f"{_compass(way)} the simulation" if size > 0.3 else "in no steady direction from the simulation"
    speed = np.linalg.norm(view.velocity[:, n], axis=-1)
    strength = np.linalg.norm(shift, axis=-1)
    link = (
        np.corrcoef(speed, strength)[0, 1] if len(speed) > 4 and speed.std() > 0.05 and strength.std() > 0.05 else 0.0
    )
    words = [
        f"{names[n]} is off by {np.sqrt((shift[frames] ** 2).sum(-1).mean()) if len(frames) else 0.0:.1f} px (root mean square) "
        f"in frames {int(frames[0]) if len(frames) else 0}-{int(frames[-1]) if len(frames) else 0}, "
        f"the clip lying {compass}"
    ]
    if abs(link) > 0.5:
        words.append(f"the misfit {'grows' if link > 0 else 'shrinks'} with its speed")
    words.append(f"mostly {CHANNELS[int(np.bincount(channel[n]).argmax())]}, {phase_of(view, n, 0, clip.frames - 1)}")
    if np.maximum(beside - 1, 0).mean() > 0.3:
        words.append("the background moves as well")
    return "; ".join(words) + "."


def _compass(way: np.ndarray) -> str:
    """Where something lies, to be followed by what from."""
    horizontal = "to the right of" if way[0] > 0 else "to the left of"
    vertical = "below" if way[1] > 0 else "above"
    if abs(way[0]) > 2 * abs(way[1]):
        return horizontal
    return vertical if abs(way[1]) > 2 * abs(way[0]) else f"{vertical} and {horizontal}"


def _distances(clip: ClipFit, fit: Fit) -> np.ndarray:
    batch = fit.hypothesis.batch(fit.z[None])
    return clip.distances(clip.predictor(clip.poses(fit.hypothesis, fit.z[None]), batch))[0][0]
