"""How much contacts may err, told by several clips: the slackness under which their measurements are likeliest."""

from __future__ import annotations

import numpy as np

from mjx_refine.diagnosis.fits.fit import ClipFit
from mjx_refine.diagnosis.joint.counts import counts_of
from mjx_refine.diagnosis.joint.fit import Clips, JointFit

GRID = (0.0, 1 / 4, 1.0)
"""Multiples of what contacts may err in one clip alone, which knows no better."""

ITERATIONS = 8


def with_slackness(clips: Clips, fit: JointFit) -> tuple[JointFit, float]:
    """Fits the base model with every slackness of ``GRID`` and keeps the likeliest; (its fit, the slackness).

    Residuals r of standard deviation one, with errors of standard deviation one along columns C, have the covariance
    I + C C'. Its determinant is the price of slack: the evidence of a fit lacks it, since it is the same for all effects.
    """
    found = []
    for slackness in GRID:
        set_slackness(clips, slackness)
        one = clips.fit(fit.hypothesis, fit.z, ITERATIONS)
        found.append((one.evidence - sum(map(_volume, clips.clips)), one, slackness))
    _, best, slackness = max(found, key=lambda told: told[0])
    set_slackness(clips, slackness)
    return best, slackness


def set_slackness(clips: Clips, slackness: float) -> None:
    """The same for all clips."""
    for clip in clips.clips:
        clip.set_slackness(slackness)


def _volume(clip: ClipFit) -> float:
    """Half the logarithm of the determinant of the measurements' covariance, up to a constant of the clip."""
    size = np.linalg.svd(clip.slack_columns, compute_uv=False)
    sigma = np.concatenate(
        [np.broadcast_to(w, part.shape).ravel() for w, part in zip(clip.widths, clip.measured.parts, strict=True)]
    )
    return float((counts_of(clip) * np.log(sigma)).sum()) + 0.5 * float(np.log1p(size**2).sum())
