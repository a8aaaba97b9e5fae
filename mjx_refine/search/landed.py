"""Where least squares took a start, and how far around it a population search begins."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from mjx_refine.space import Space

LANDED_WELL = 0.93
"""IoU above which nothing more is tried before the population search."""

NARROW = (0.25, 0.05)
"""After a good landing, the first generation's (factor on the variance that the landing found, prior widths that it may
spread where the landing left a parameter open). More, and contacts beyond those landed on spoil nearly every candidate."""

WIDE = (4.0, 0.2)
"""The same after a poor landing, which the population search must leave again."""

WIDTHS = np.array([1.0, 0.5, 0.25, 0.125])
"""Of the first generation, in multiples of what the landing proposes: contacts may leave less room than derivatives say."""

PROBES = 10
"""Draws by which each is judged."""

PROBING = 8 * (len(WIDTHS) * PROBES + 1)
"""Rollouts left below which they are not judged: that would take too many."""

LOSS = 0.006
"""Fitness that half of the first generation's candidates may lose; from more they do not recover in time."""


@dataclasses.dataclass
class Landed:
    """A start and where least squares took it."""

    rank: int
    point: np.ndarray
    covariance: np.ndarray
    fitness: float
    iou: float


def first_covariance(landed: Landed, space: Space) -> np.ndarray:
    """Covariance of the first generation after a landing, unit box."""
    factor, widths = NARROW if landed.iou >= LANDED_WELL else WIDE
    scale = np.outer(space.sigma, space.sigma)
    # In prior widths the landing's inverse covariance is what the clip told, plus one for the prior.
    told = np.linalg.inv(landed.covariance / scale) - np.eye(space.dimension)
    covariance = np.linalg.inv(told / factor + np.eye(space.dimension) / widths**2) * scale
    return (covariance + covariance.T) / 2


def landed_well(landings: list[Landed]) -> bool:
    """Whether the best of the landings is one that the search need not leave."""
    return bool(landings) and max(landings, key=lambda landed: landed.fitness).iou >= LANDED_WELL


def fitting_width(
    costs_of: Callable[[np.ndarray], np.ndarray], mean: np.ndarray, covariance: np.ndarray, seed: int
) -> tuple[float, int]:
    """Factor on the first generation's standard deviations, the largest of ``WIDTHS`` whose draws lose little.

    Args:
      costs_of: costs of points (B, D) in the unit box.
      mean, covariance: of the first generation as proposed.
      seed: of the draws.

    Returns:
      (factor, rollouts that it took).
    """
    generator = np.random.default_rng([seed, 1])
    steps = generator.standard_normal((PROBES // 2, len(mean))) @ np.linalg.cholesky(covariance).T
    points = mean + np.multiply.outer(WIDTHS, np.concatenate([steps, -steps])).reshape(-1, len(mean))
    costs = costs_of(np.clip(np.concatenate([mean[None], points]), 0.0, 1.0))
    costs = np.where(np.isfinite(costs), costs, np.inf)
    losses = np.median(costs[1:].reshape(len(WIDTHS), PROBES), axis=1) - costs[0]
    fitting = np.nonzero(losses < LOSS)[0]
    return float(WIDTHS[fitting[0] if len(fitting) else -1]), len(costs)
