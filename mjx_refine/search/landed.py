"""Where least squares took a start, and how far around it a population search begins."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_refine.space import Space

LANDED_WELL = 0.93
"""IoU above which nothing more is tried before the population search."""

NARROW = (1.0, 0.1)
"""After a good landing, the first generation's (factor on the variance that the landing found, prior widths that it may
spread where the landing left a parameter open). Less, and the search stays in the wrinkle that it began in."""

WIDE = (4.0, 0.2)
"""The same after a poor landing, which the population search must leave again."""


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
