"""The population search of one clip, a generation at a time: whoever has the points evaluated tells their costs.

So one clip and many in lock-step run the same search.
"""

from __future__ import annotations

from typing import Any

import mjx_cmaes
import numpy as np
from jaxtyping import Float
from mjx_fitness import Scores

from mjx_refine.search.options import Options

GENERATIONS = 80
"""Generations for which the budget after a landing must suffice; the population shrinks, down to CMA-ES's default
4 + 3 ln n (Hansen, The CMA Evolution Strategy: A Tutorial, 2023, table 1), until it does."""

POLISHING = 120
"""The same after a good landing: following one basin takes fewer candidates than finding one."""

STILL, GAIN = 30, 2e-5
"""Generations without so much gain of fitness after which a search around a good landing begins anew, from its best point:
contacts make the fitness jagged, and a population that is too wide for them may go astray at once and never come back."""

SPREADS = (0.1, 4.0, 1.0)
"""Factors on the landing's covariance for new beginnings, in turn."""

ELITES = 8
"""Candidates of the search that are compared at full resolution in the end."""

SPENT = "The budget of rollouts is spent."
LANDED_OUT = "The budget of rollouts was spent by least squares."


class PopulationSearch:
    """CMA-ES around a landing, or around a sample.

    Args:
      options: budget, population, seed.
      mean, covariance: of the first generation, unit box.
      start: a point that the first generation contains beside the mean.
      landed: whether the mean is a good landing.
      evaluations: rollouts spent before.
      part: of what is left of the budget that the search can count on.

    Attributes:
      evaluations: rollouts spent.
      reason: why the search ended, None before.
      best: (fitness, IoU, EPE [px]) of the best candidate of all generations, at the search's resolution.
      fine: whether that is the finer one, see ``refocus``.
    """

    def __init__(
        self,
        options: Options,
        mean: Float[np.ndarray, "dimension"],
        covariance: Float[np.ndarray, "dimension dimension"],
        start: Float[np.ndarray, "dimension"],
        landed: bool,
        evaluations: int,
        part: float = 1.0,
    ):
        self.options, self.mean, self.covariance, self.start = options, mean, covariance, start
        self.evaluations = evaluations
        self.best = (-np.inf, 0.0, 0.0)
        self.reason: str | None = None
        self.state: mjx_cmaes.State | None = None
        self.fine = self._refocused = False
        left = options.budget - evaluations
        self._population(self._fitting(int(part * left), POLISHING if landed else GENERATIONS))
        self._landed, self._still, self._beginnings = landed, 0, 0
        self.elites, self._costs = mean[None], np.full(1, np.inf)
        if left < self.population:
            self.reason = LANDED_OUT

    def _population(self, count: int) -> None:
        self.population = count
        self.settings = mjx_cmaes.Settings(dimension=len(self.mean), population=count)

    def _fitting(self, left: int, generations: int) -> int:
        """Candidates a generation: after a landing, few enough for so many generations with what is left."""
        if self.options.optimizer == "cmaes":
            return self.options.population
        least = min(self.options.population, 4 + int(3 * np.log(len(self.mean))))
        return int(np.clip(left // generations, least, self.options.population))

    def points(self) -> Float[np.ndarray, "batch dimension"] | None:
        """The next points whose costs are wanted; None where the search has ended, ``reason`` then says why."""
        if self.reason is not None:
            return None
        if self.state is None:
            self.state = mjx_cmaes.init(self.settings, self.mean, covariance=self.covariance, seed=self._seed)
        if self.evaluations + self.population > self.options.budget:
            self.reason = SPENT
            return None
        if self._landed and self._still >= STILL:
            self._begin_anew()
        reason = mjx_cmaes.should_stop(self.settings, self.state)
        if reason is not None:
            self.reason = str(reason)
            return None
        points, self.state = mjx_cmaes.ask(self.settings, self.state)
        if self.state.generation == 0:
            first = [self.elites[0]] if self._beginnings else [self.mean, self.start]
            points = mjx_cmaes.inject(points, np.stack(first))
        elif self._refocused:
            points = mjx_cmaes.inject(points, np.stack([np.clip(self.state.mean, 0, 1), self.elites[0]]))
        return points

    def _begin_anew(self) -> None:
        covariance = SPREADS[self._beginnings % len(SPREADS)] * self.covariance
        self._beginnings, self._still = self._beginnings + 1, 0
        seed = (self._seed + self._beginnings) % 2**32
        self.state = mjx_cmaes.init(self.settings, self.elites[0], covariance=covariance, seed=seed)

    def refocus(self) -> None:
        """From the next generation on, pictures are compared at another resolution: costs so far mean nothing there."""
        self.fine = self._refocused = True
        self.elites, self._costs = self.elites[:1], np.full(1, np.inf)
        self.best = (-np.inf, 0.0, 0.0)

    @property
    def _seed(self) -> int:
        return self.options.seed

    def told(
        self, points: Float[np.ndarray, "batch dimension"], costs: Float[np.ndarray, "batch"], scores: Scores
    ) -> bool:
        """Takes the costs and scores of what ``points`` returned; True where that was a generation."""
        if self.state is None:
            raise RuntimeError("costs of points that nobody asked for")
        self._refocused = False
        self.state, _ = mjx_cmaes.tell(self.settings, self.state, points, costs)
        self.evaluations += len(points)
        before = self._costs.min()
        self.elites, self._costs, best = _merge(self.elites, self._costs, points, costs)
        self._still = 0 if self._costs.min() < before - GAIN else self._still + 1
        if best is not None:
            self.best = (-float(costs[best]), float(scores.iou[best]), float(scores.epe[best]))
        return True

    @property
    def spread(self) -> float:
        """Mean standard deviation of the population, unit box."""
        return float(self.state.std.mean()) if self.state is not None else 0.0

    @property
    def found(self) -> list[np.ndarray]:
        """Points for the finish, the population's mean first."""
        return [] if self.state is None else [np.clip(self.state.mean, 0, 1), *self.elites]

    def saved(self) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
        """(values, arrays) for a checkpoint; None before the first generation."""
        if self.state is None or self.state.generation == 0:
            return None
        arrays = {f"cma.{k}": v for k, v in mjx_cmaes.save_state(self.state).items()}
        arrays.update(elites=self.elites, elite_costs=self._costs)
        values = {"best": self.best, "population": self.population, "fine": self.fine}
        return {**values, "still": self._still, "beginnings": self._beginnings}, arrays

    def restore(self, values: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Goes on from what ``saved`` returned.

        Raises:
          KeyError, ValueError, TypeError: it is damaged.
        """
        self._population(int(values["population"]))
        self.reason = None
        state = {k.removeprefix("cma."): v for k, v in arrays.items() if k.startswith("cma.")}
        self.state = mjx_cmaes.load_state(self.settings, state)
        self.elites, self._costs = arrays["elites"], arrays["elite_costs"]
        self.fine = bool(values.get("fine"))
        self._still, self._beginnings = int(values.get("still", 0)), int(values.get("beginnings", 0))
        fitness, iou, epe = values["best"]
        self.best = (float(fitness), float(iou), float(epe))


def _merge(
    elites: Float[np.ndarray, "elites dimension"], elite_costs: np.ndarray, points: np.ndarray, costs: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int | None]:
    """The best of old elites and new points, and the row of a new overall best (None where there is none)."""
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    improved = costs[best] < elite_costs.min()
    together, prices = np.concatenate([elites, points]), np.concatenate([elite_costs, costs])
    order = np.argsort(np.where(np.isfinite(prices), prices, np.inf), kind="stable")[:ELITES]
    return together[order], prices[order], best if improved else None
