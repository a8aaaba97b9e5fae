"""Where simulated and measured poses part, in frames of the simulation, and in words with metres and degrees."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from mjx_refine.diagnosis.fits.fit import Fit
from mjx_refine.diagnosis.misfit.where import phase_of
from mjx_refine.diagnosis.poses.fit import PosesFit
from mjx_refine.diagnosis.poses.heldout import shifts_of
from mjx_refine.diagnosis.result import CHANNELS
from mjx_refine.effects.kind import FitView

QUIET = 0.3
"""Mean excess of the squared misfit [noise widths squared] below which nothing is said of it."""

MUCH = 3.0
"""Noise widths from which errors that impacts excuse are told."""

STEADY = 0.5
"""Part of the misfit that its mean must be for its direction to be named."""


def misfit_map(
    clip: PosesFit, fit: Fit
) -> tuple[Float[np.ndarray, "objects frames"], Int[np.ndarray, "objects frames"], Float[np.ndarray, "frames"]]:
    """(mean square misfit by object and simulated frame, its channel, zeros); zero in frames without a sample."""
    parts = clip.measured.split(fit.residual)
    moved = (parts.moments**2).sum(-1)
    turned = (parts.reach**2).sum(-1)
    known = np.isfinite(clip.measured.moments).sum(-1) + np.isfinite(clip.measured.reach).sum(-1)
    frame = np.clip(np.round(clip.place).astype(int), 0, clip.frames - 1)

    def binned(values: np.ndarray) -> np.ndarray:
        sums = np.zeros((clip.frames, values.shape[1]))
        np.add.at(sums, frame, values)
        return sums.T

    total = binned(moved + turned) / np.maximum(binned(known.astype(float)), 1.0)
    turns = binned(turned) > binned(moved)
    channel = np.where(turns, CHANNELS.index("rotation"), CHANNELS.index("motion"))
    return total, channel, np.zeros(clip.frames)


def seen_frames(clip: PosesFit) -> np.ndarray:
    """Which objects were measured in which simulated frames, (objects, frames)."""
    frame = np.clip(np.round(clip.place).astype(int), 0, clip.frames - 1)
    seen = np.zeros((clip.frames, clip.measured.present.shape[1]), bool)
    np.logical_or.at(seen, frame, clip.measured.present)
    return seen.T


def describe(clip: PosesFit, fit: Fit, view: FitView) -> str:
    """The misfit in plain words: which object, when, which way, how it goes with speed."""
    energy, channel, _ = misfit_map(clip, fit)
    excess = np.maximum(energy - 1.0, 0.0)
    if excess.sum() < QUIET * max(seen_frames(clip).sum(), 1):
        return quiet(clip, fit)
    names = fit.hypothesis.space.scene.names
    n = int(excess.sum(1).argmax())
    frames = np.nonzero(excess[n] > 0.5)[0]
    first, last = int(frames[0]), int(frames[-1])
    moved, turned = (shift[:, n] for shift in shifts_of(clip, fit))
    during = (clip.place > first - 0.5) & (clip.place < last + 0.5)
    words = [
        f"{names[n]} is off by {_size(moved, turned, during)} (root mean square) from {first / view.fps:.2f} s to "
        f"{last / view.fps:.2f} s{_way(moved[during])}"
    ]
    strength = np.sqrt(np.nansum(moved**2, -1))
    velocity = np.linalg.norm(view.velocity[:, n], axis=-1)
    speed = np.interp(clip.place, np.arange(view.frames), velocity)
    if len(speed) > 4 and speed.std() > 0.05 and strength.std() > 1e-6:
        link = float(np.corrcoef(speed, strength)[0, 1])
        if abs(link) > 0.5:
            words.append(f"the misfit {'grows' if link > 0 else 'shrinks'} with its speed")
    words.append(f"mostly {CHANNELS[int(np.bincount(channel[n, frames]).argmax())]}, {phase_of(view, n, first, last)}")
    return "; ".join(words) + "."


def quiet(clip: PosesFit, fit: Fit) -> str:
    """Where nothing is above the noise and what impacts may err: how much that was."""
    moved, turned = shifts_of(clip, fit)
    widths = clip.measured.moment_noise, clip.measured.edge_noise[:, None]
    for n, name in enumerate(fit.hypothesis.space.scene.names):
        for shift, width in ((moved, widths[0]), (turned, widths[1])):
            seen = shift[np.isfinite(shift[:, n]).any(-1), n] / width[n]
            if len(seen) and np.sqrt(np.nanmean(seen**2)) > MUCH:
                size = _size(moved[:, n], turned[:, n], np.ones(len(moved), bool))
                return (
                    f"Nothing above the measurement's noise and what impacts may err, which here is much: {name} is off by "
                    f"{size} (root mean square)."
                )
    return "Nothing above the measurement's noise."


def _size(moved: np.ndarray, turned: np.ndarray, during: np.ndarray) -> str:
    parts = []
    for shift, factor, unit in ((moved, 1e3, "mm"), (turned, 180 / np.pi, "degrees")):
        told = shift[during]
        told = told[np.isfinite(told).any(-1)]
        if len(told):
            parts.append(f"{factor * np.sqrt(np.nansum(told**2, -1).mean()):.3g} {unit}")
    return " and ".join(parts) or "an unknown amount"


def _way(moved: np.ndarray) -> str:
    """Which way the measured positions lie of the simulated ones, where they do so steadily."""
    known = np.isfinite(moved).any(-1)
    if not known.any():
        return ""
    mean = -np.nan_to_num(moved[known]).mean(0)
    size = np.sqrt(np.nansum(moved[known] ** 2, -1).mean())
    if np.linalg.norm(mean) < STEADY * size:
        return ", in no steady direction"
    k = int(np.abs(mean).argmax())
    side = (("-x", "+x"), ("-y", "+y"), ("below", "above"))[k][int(mean[k] > 0)]
    return f", the measured one lying {side} the simulated" if k == 2 else f", the measured one lying towards {side}"
