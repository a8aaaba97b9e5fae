"""The gap on measured poses that no fit has seen, in noise widths and in metres."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.diagnosis.fits.fit import Fit
from mjx_refine.diagnosis.misfit.heldout import BLOCK, HeldOut
from mjx_refine.diagnosis.poses.fit import VIDEO, PosesFit

BINS = 1.0 / VIDEO
"""Samples that lie this close together err together [s]: their mean counts once."""


@dataclasses.dataclass(frozen=True)
class Errors:
    """Root mean square errors over all measured objects.

    Attributes:
      position: [m]; NaN where none was measured.
      rotation: [rad]; ditto.
    """

    position: float
    rotation: float


def bins_of(time: Float[np.ndarray, "times"]) -> np.ndarray:
    """Which bin each sample belongs to: a video's frame, or a sample where these come more rarely."""
    step = max(BINS, float(np.median(np.diff(time))))
    return np.floor(time / step + 1e-6).astype(int)


def kept_samples(time: Float[np.ndarray, "times"]) -> Bool[np.ndarray, "times"]:
    """All samples but those in every third block of three bins."""
    return (bins_of(time) // BLOCK) % 3 != 2


def held_out(clip: PosesFit, base: Fit, other: Fit | None) -> tuple[HeldOut, Errors, Errors]:
    """Fits both on the kept samples, from where they ended on all, and looks at the others."""
    keep = kept_samples(clip.time)
    first, before = _outside(clip, base, keep)
    second, after = (first, before) if other is None else _outside(clip, other, keep)
    bins = bins_of(clip.time)
    seen = clip.measured.present.any(1)
    chosen = ~keep & seen if (~keep & seen).any() else ~keep
    groups = [chosen & (bins == b) for b in np.unique(bins[chosen])]
    floor = float(np.sqrt(np.mean(_by_sample(clip, _rough(clip, other or base))[chosen])))
    gain = 0.5 * float((first - second)[chosen].sum()) * clip.expected() / len(clip.time)

    def rooted(energy: np.ndarray) -> np.ndarray:
        return np.sqrt(np.array([energy[group].mean() for group in groups]))

    return HeldOut(rooted(first), rooted(second), min(floor, 1.0), gain), before, after


def _outside(clip: PosesFit, fit: Fit, keep: np.ndarray) -> tuple[np.ndarray, Errors]:
    """Mean square residual of every sample [noise widths squared], and errors of the held-out ones."""
    again = clip.fit(fit.hypothesis, fit.z, 6, keep=keep)
    position, rotation = errors_of(clip, again)
    energy = _by_sample(clip, clip.whitened(_distances(clip, again), None, 20.0, again.hypothesis)[0])
    return energy, Errors(_root(position[~keep]), _root(rotation[~keep]))


def _distances(clip: PosesFit, fit: Fit):
    poses = clip.poses(fit.hypothesis, fit.z[None])
    return clip.distances(clip.predictor(poses, fit.hypothesis.batch(fit.z[None])))


def shifts_of(clip: PosesFit, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Simulated minus measured: positions [m] and rotation vectors [rad], each (times, objects, 3); NaN: not measured."""
    told = _distances(clip, fit)
    return told.moments[0], told.reach[0]


def errors_of(clip: PosesFit, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Distances [m] and angles [rad] between simulation and measurement, (times, objects); NaN: not measured."""
    results = []
    for shift in shifts_of(clip, fit):
        length = np.sqrt(np.nansum(shift**2, -1))
        results.append(np.where(np.isfinite(shift).any(-1), length, np.nan))
    return results[0], results[1]


def total(clip: PosesFit, fit: Fit) -> Errors:
    """Root mean square errors over all samples."""
    return Errors(*(_root(values) for values in errors_of(clip, fit)))


def _root(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _by_sample(clip: PosesFit, white: np.ndarray) -> np.ndarray:
    """Sum of squares of each sample's residuals over what noise alone gives."""
    parts = clip.measured.split(white)
    total = (parts.reach**2).sum((1, 2)) + (parts.moments**2).sum((1, 2))
    return total / max(clip.expected() / len(clip.time), 1e-9)


def _rough(clip: PosesFit, fit: Fit) -> np.ndarray:
    """What of a fit's residuals changes from sample to sample, as noise does, as residuals."""
    rows = []
    for series in clip.measured.split(fit.residual):
        step = np.diff(series, axis=0) / np.sqrt(2.0)
        rows.append(np.concatenate([step[:1], step]).ravel())
    return np.concatenate(rows)
