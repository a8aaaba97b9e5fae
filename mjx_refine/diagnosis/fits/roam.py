"""A small evolution strategy that looks around the end of a least squares fit, over the jags that contacts leave."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.fitted import Fit

OFFSPRING = 40
"""Of a generation."""

GENERATIONS, FRUITLESS = 16, 8
"""Of a round, and of one that finds nothing better: what those after it found in a clip without jags was worth 1 to 3."""

ROAMED, ROAMED_AGAIN = (1.0, 4.0), (2.0,)
"""Widths of the first generation in each round, of the base model's fit and of effects' [posterior standard deviations]."""


class Strategy:
    """Weighted recombination with a path that sets the step (Hansen and Ostermeier 2001, CSA-ES), in coordinates in which
    the posterior is round: there is no time to learn a covariance, and the fit tells one.

    Args:
      dimension: of the points, which are distances from the fit.
      width: of the first generation.
      seed: of the draws.
    """

    def __init__(self, dimension: int, width: float, seed: int):
        self._generator = np.random.default_rng(seed)
        self._width, self._mean, self._path = width, np.zeros(dimension), np.zeros(dimension)
        parents = OFFSPRING // 2
        weights = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
        self._weights = weights / weights.sum()
        mass = 1.0 / float((self._weights**2).sum())
        self._rate = (mass + 2) / (dimension + mass + 5)
        self._damping = 1 + self._rate + 2 * max(0.0, np.sqrt((mass - 1) / (dimension + 1)) - 1)
        self._kick = np.sqrt(self._rate * (2 - self._rate) * mass)
        self._length = np.sqrt(dimension) * (1 - 1 / (4 * dimension) + 1 / (21 * dimension**2))
        self._drawn = np.zeros((OFFSPRING, dimension))

    def ask(self) -> Float[np.ndarray, "offspring dimension"]:
        """The next generation."""
        half = self._generator.standard_normal((OFFSPRING // 2, len(self._mean)))
        self._drawn = np.concatenate([half, -half])
        return self._mean + self._width * self._drawn

    def tell(self, costs: Float[np.ndarray, "offspring"]) -> None:
        """What each of the last generation costs; infinite where it diverged."""
        best = np.argsort(costs, kind="stable")[: len(self._weights)]
        step = self._weights @ self._drawn[best]
        self._mean = self._mean + self._width * step
        self._path = (1 - self._rate) * self._path + self._kick * step
        grown = float(np.linalg.norm(self._path)) / self._length - 1
        self._width *= float(np.exp(min(self._rate / self._damping * grown, 1.0)))


def looked_around(
    fit: Fit, strategy: Strategy, residuals: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> tuple[float, Float[np.ndarray, "dimension"]]:
    """(cost, point) of the cheapest point that the strategy finds around a fit; the fit's own where none is cheaper.

    Args:
      fit: where it begins; its posterior's coordinates are the strategy's.
      strategy: that has not begun.
      residuals: of points, one a row, with what they cost.
    """
    factor = np.linalg.inv(np.linalg.cholesky(fit.curvature))
    best, point = fit.cost, fit.z
    for generation in range(GENERATIONS):
        if generation == FRUITLESS and best == fit.cost:
            break
        points = np.clip(fit.z + strategy.ask() @ factor, *fit.hypothesis.bounds)
        costs = residuals(points)[1]
        if np.min(costs) < best:
            best, point = float(np.min(costs)), points[int(np.argmin(costs))]
        strategy.tell(costs)
    return best, point


def hopped(
    fit: Fit,
    seed: int,
    rounds: int,
    count: int,
    residuals: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    fitted: Callable[[np.ndarray], Fit],
) -> Fit:
    """Least squares again from better points around a fit's end: draws from its own posterior at several widths.

    After contacts the residuals are jagged, and derivatives see only the nearest step.

    Args:
      fit: where least squares ended.
      seed: of the draws.
      rounds: how often.
      count: of draws a round.
      residuals: of points, one a row, and their costs.
      fitted: least squares from a point.
    """
    generator = np.random.default_rng(seed)
    for _ in range(rounds):
        factor = np.linalg.inv(np.linalg.cholesky(fit.curvature))
        width = np.geomspace(0.3, 8.0, count)[:, None]
        draws = generator.standard_normal((count, len(fit.z))) @ factor * width
        points = np.clip(fit.z + draws, *fit.hypothesis.bounds)
        _, costs = residuals(points)
        best = int(np.argsort(costs)[0])
        if costs[best] < fit.cost + 0.1 * abs(fit.cost):
            trial = fitted(points[best])
            fit = trial if trial.cost < fit.cost else fit
    return fit
