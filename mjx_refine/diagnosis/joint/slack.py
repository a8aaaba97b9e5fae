"""How much contacts may err, told by several clips: the slackness under which the base model's residuals are likeliest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjx_refine.diagnosis.fit import SCALE, ClipFit, Fit

GRID = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Multiples of what contacts may err in one clip alone, which knows no better."""


def told_slackness(clips: Sequence[ClipFit], fits: Sequence[Fit]) -> float:
    """The likeliest of ``GRID``, by the residuals that fits without slack leave.

    Residuals r of standard deviation one, with errors of standard deviation one along columns C, have the covariance
    I + C C'; its likelihood is compared over how much the columns are scaled.
    """
    return GRID[int(np.argmax([sum(_likelihood(c, f, s) for c, f in zip(clips, fits, strict=True)) for s in GRID]))]


def _likelihood(clip: ClipFit, fit: Fit, slackness: float) -> float:
    residual = plain_residual(clip, fit)
    basis, size, _ = np.linalg.svd(clip.slack_columns(slackness), full_matrices=False)
    along = (basis.T @ residual) ** 2
    wide = 1.0 + size**2
    explained = float((along * (1.0 - 1.0 / wide)).sum())
    return -0.5 * (float(residual @ residual) - explained) - 0.5 * float(np.log(wide).sum())


def plain_residual(clip: ClipFit, fit: Fit, scale: float = SCALE) -> np.ndarray:
    """Residuals of a fit in widths of the noise in which contacts may not err."""
    batch = fit.hypothesis.batch(fit.z[None])
    away = clip.distances(clip.predictor(clip.poses(fit.hypothesis, fit.z[None]), batch))
    return clip.rigid(away, None, scale)[0]
