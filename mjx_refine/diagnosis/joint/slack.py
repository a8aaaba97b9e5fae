"""How much contacts may err, told by several clips: the slackness under which the base model's residuals are likeliest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjx_refine.diagnosis.fit import SCALE, ClipFit, Fit
from mjx_refine.diagnosis.joint.counts import counts_of

GRID = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Multiples of what contacts may err in one clip alone, which knows no better."""


def set_slackness(clips: Sequence[ClipFit], fits: Sequence[Fit]) -> float:
    """Sets the likeliest of ``GRID``, by the residuals that fits leave, and returns it.

    Residuals r of standard deviation one, with errors of standard deviation one along columns C, have the covariance
    I + C C'; its likelihood is compared over how much the columns, and the uncertain moments of impacts, are scaled.
    """
    away = [_away(clip, fit) for clip, fit in zip(clips, fits, strict=True)]
    values = []
    for slackness in GRID:
        for clip in clips:
            clip.set_slackness(slackness)
        values.append(sum(_likelihood(clip, distances) for clip, distances in zip(clips, away, strict=True)))
    best = GRID[int(np.argmax(values))]
    for clip in clips:
        clip.set_slackness(best)
    return best


def _away(clip: ClipFit, fit: Fit):
    batch = fit.hypothesis.batch(fit.z[None])
    return clip.distances(clip.predictor(clip.poses(fit.hypothesis, fit.z[None]), batch))


def _likelihood(clip: ClipFit, distances) -> float:
    """Logarithm of it, up to a constant of the clip."""
    residual = clip.rigid(distances, None, SCALE)[0]
    basis, size, _ = np.linalg.svd(clip.slack_columns, full_matrices=False)
    along = (basis.T @ residual) ** 2
    wide = 1.0 + size**2
    explained = float((along * (1.0 - 1.0 / wide)).sum())
    sigma = np.concatenate(
        [
            np.broadcast_to(width, part.shape).ravel()
            for width, part in zip(clip.widths, clip.measured.parts, strict=True)
        ]
    )
    volume = float((counts_of(clip) * np.log(sigma)).sum()) + 0.5 * float(np.log(wide).sum())
    return -0.5 * (float(residual @ residual) - explained) - volume
