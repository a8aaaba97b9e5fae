"""The gap on clips that no fit has seen.

Of a held-out clip the set-up and its effects stay as the fitted clips have them; only where and how fast its objects start
is fitted, on its first ``EARLY`` part, and the rest of it is foretold. No frame that is judged was seen by any fit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.joint.counts import counts_of
from mjx_refine.diagnosis.joint.hypothesis import with_frozen_setup
from mjx_refine.diagnosis.misfit.heldout import BLOCK, in_common

EARLY = 0.4
"""Part of a held-out clip on which its start is fitted."""

FORGIVING = 40.0
"""Scale of the robust loss while the start is far off [noise widths]."""

WIDE = 20.0
"""Ditto of the errors that are judged."""

DRAWS = 12
"""Of the start's posterior, which say how well it foretells the rest."""

GOOD = 2.5
"""Mean square residual of the first part above which another start is looked for."""

FEW = 3
"""Clips below which an interval is taken over blocks of frames, since so few say nothing of others."""

BOOTSTRAP = 1000

BEYOND, MOST = 2.0, 0.75
"""Multiple of what may be off that errors must be, in this part of the clips, for something to be missing."""


def split(count: int, seed: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Which clips are fitted and which are judged: half and half, at random, the first always fitted since it is shown."""
    others = 1 + np.random.default_rng((seed, count)).permutation(count - 1)
    judged = sorted(int(k) for k in others[: count // 2])
    return tuple(k for k in range(count) if k not in judged), tuple(judged)


def early_part(time: Float[np.ndarray, "frames"]) -> Bool[np.ndarray, "frames"]:
    """The frames that a held-out clip's start is fitted on."""
    return time <= time[0] + EARLY * (time[-1] - time[0])


@dataclasses.dataclass(frozen=True)
class Foretold:
    """What one hypothesis says of a held-out clip's later frames.

    Attributes:
      fit: of its start.
      energy: mean square error by later frame [noise widths squared].
      likelihood: logarithm of how likely the later frames were, up to a constant of the clip.
      floor: root mean square error that noise, and what is not known of the start, would give if all else were right.
      excused: ditto if contacts err as much as the fitted clips' do; NaN where that was not asked for.
    """

    fit: Fit
    energy: Float[np.ndarray, "later"]
    likelihood: float
    floor: float
    excused: float = math.nan

    @property
    def error(self) -> float:
        """Root mean square over the later frames [noise widths]."""
        return float(np.sqrt(self.energy.mean()))


def foretell(clip: ClipFit, part: Hypothesis, z: Float[np.ndarray, "part"], early: np.ndarray, seed: int) -> Foretold:
    """Fits a held-out clip's start with the set-up at ``z`` and foretells the rest.

    Args:
      clip: its residuals; contacts must not have been allowed to err.
      part: the hypothesis.
      z: the shared coordinates count, the others do not.
      early: frames that may be seen.
      seed: of the hops.
    """
    hypothesis = with_frozen_setup(part, z)
    at = np.zeros(hypothesis.dimension)
    frames = np.nonzero(early)[0]
    for share in (0.5, 1.0):
        keep = early & (np.arange(len(early)) <= frames[max(int(share * len(frames)) - 1, 3)])
        at = clip.fit(hypothesis, at, 8, keep, FORGIVING).z
    fit = clip.fit(hypothesis, at, 10, early)
    if (fit.residual**2).sum() > GOOD * (counts_of(clip) * clip.measured.kept(early)).sum():
        fit = clip.hop(fit, seed, 2, 48, early)
    return _foretold(clip, fit, early, seed)


def _foretold(clip: ClipFit, fit: Fit, early: np.ndarray, seed: int) -> Foretold:
    generator = np.random.default_rng(seed)
    factor = np.linalg.inv(np.linalg.cholesky(fit.curvature))
    draws = np.clip(fit.z + generator.standard_normal((DRAWS, len(fit.z))) @ factor, *fit.hypothesis.bounds)
    z = np.concatenate([fit.z[None], draws])
    prediction = clip.predictor(clip.poses(fit.hypothesis, z), fit.hypothesis.batch(z))
    counts = counts_of(clip) * clip.measured.kept(~early)
    rows = clip.rigid(clip.distances(prediction), None, WIDE) / np.sqrt(np.maximum(counts_of(clip), 1e-12))
    rows = np.where(counts > 0, rows, 0.0)
    spread = (
        np.median((rows[1:][~prediction.bad[1:]] - rows[0]) ** 2, 0) if not prediction.bad[1:].all() else 0 * rows[0]
    )
    variance = 1.0 + spread
    likelihood = -0.5 * float((counts * (rows[0] ** 2 / variance + np.log(variance))).sum())
    outlines = _of_outlines(clip, counts)
    floor = float(np.sqrt((outlines * variance).sum() / max(float(outlines.sum()), 1e-9)))
    energy = _by_frame(clip, outlines * rows[0] ** 2) + in_common(clip, np.sqrt(counts) * rows[0])
    return Foretold(fit, (energy / np.maximum(_by_frame(clip, outlines), 1e-9))[~early], likelihood, floor)


def excused(clip: ClipFit, told: Foretold, early: np.ndarray, slackness: float) -> Foretold:
    """With how far contacts may take the later frames off, which nothing else is to be blamed for."""
    before = clip.noise
    clip.slackness = slackness
    clip.allow_slack(told.fit)
    blur, columns = np.concatenate([w.ravel() for w in _squares(clip)]), clip.slack_columns
    clip.forget_slack(before)
    plain = np.concatenate([w.ravel() for w in _squares(clip)])
    counts = _of_outlines(clip, counts_of(clip) * clip.measured.kept(~early))
    # Columns are in widths of the blurred noise, times the root of the count.
    wide = (columns**2).sum(1) / np.maximum(counts_of(clip), 1e-12) * blur / plain + (blur - plain) / plain
    more = float((counts * np.minimum(wide, WIDE**2)).sum() / max(float(counts.sum()), 1e-9))
    return dataclasses.replace(told, excused=float(np.sqrt(told.floor**2 + more)))


def _squares(clip: ClipFit) -> list[np.ndarray]:
    """Variances of the noise, in the measurements' shapes."""
    return [np.broadcast_to(w, part.shape) ** 2.0 for w, part in zip(clip.widths, clip.measured.parts, strict=True)]


def _of_outlines(clip: ClipFit, counts: np.ndarray) -> Float[np.ndarray, "residuals"]:
    """Counts of outlines and centroids (of poses: of all that there is), and none of flow, of which only what it has in common is
    told (``in_common``)."""
    parts = clip.measured.split(counts)
    return np.concatenate(
        [part.ravel() for part in parts._replace(flow=0 * parts.flow, background=0 * parts.background)]
    )


def _by_frame(clip: ClipFit, numbers: np.ndarray) -> Float[np.ndarray, "frames"]:
    """Sums over each frame's outlines and centroids."""
    parts = clip.measured.split(numbers)
    return parts.reach.sum((1, 2)) + parts.moments.sum((1, 2))


# --- over all judged clips ---------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Outside:
    """What the base model and another hypothesis leave of held-out clips.

    Attributes:
      before: by the base model, a clip each.
      after: by the other.
    """

    before: tuple[Foretold, ...]
    after: tuple[Foretold, ...]

    @property
    def gains(self) -> Float[np.ndarray, "clips"]:
        """Of likelihood, by clip [natural logarithms]."""
        return np.array([a.likelihood - b.likelihood for b, a in zip(self.before, self.after, strict=True)])

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Medians over clips of the errors before and after, and of the floor [noise widths]."""
        return middle(self.before), middle(self.after), float(np.median([f.floor for f in (*self.before,)]))

    @property
    def closed(self) -> float:
        """(before - after) / (before - floor)."""
        return _closed(*self.numbers)

    @property
    def excused(self) -> float:
        """Median over clips of what noise, starts and contacts may do to the errors before [noise widths]."""
        return float(np.median([f.excused for f in self.before]))

    @property
    def inexplicable(self) -> bool:
        """Whether the base model foretells most clips much worse than all that may be off."""
        far = [f.error > BEYOND * f.excused for f in self.before]
        return float(np.mean(far)) >= MOST

    def sure(self, seed: int, share: float = 0.95) -> bool:
        """Whether the gain is no accident of which clips were judged (bootstrap over them)."""
        gains = self.gains
        if len(gains) < FEW:
            return bool((gains > 0).all())
        draws = np.random.default_rng(seed).integers(0, len(gains), (BOOTSTRAP, len(gains)))
        return bool((np.median(gains[draws], 1) > 0).mean() >= share)

    def interval(self, seed: int) -> tuple[float, float]:
        """90 % bootstrap interval of ``closed``: over clips (Efron 1979), of few over blocks of frames (Kuensch 1989)."""
        generator, count = np.random.default_rng(seed), len(self.before)
        pairs = list(zip(self.before, self.after, strict=True))
        draws = []
        for _ in range(BOOTSTRAP):
            if count >= FEW:
                chosen = [pairs[k] for k in generator.integers(0, count, count)]
            else:
                chosen = [_resampled(b, a, generator) for b, a in pairs]
            draws.append(Outside(*zip(*chosen, strict=True)).closed)
        low, high = np.quantile(draws, [0.05, 0.95])
        return float(low), float(high)


def middle(told: Sequence[Foretold]) -> float:
    """Median of the clips' errors."""
    return float(np.median([f.error for f in told]))


def _resampled(before: Foretold, after: Foretold, generator: np.random.Generator) -> tuple[Foretold, Foretold]:
    count = len(before.energy)
    blocks = np.array_split(np.arange(count), max(count // BLOCK, 1))
    rows = np.concatenate([blocks[k] for k in generator.integers(0, len(blocks), len(blocks))])
    return dataclasses.replace(before, energy=before.energy[rows]), dataclasses.replace(
        after, energy=after.energy[rows]
    )


def _closed(before: float, after: float, floor: float) -> float:
    floor = min(floor, before, after)
    return float(np.clip((before - after) / (before - floor), -1.0, 1.0)) if before - floor > 1e-3 else 0.0
