"""Population searches from several poor landings: each has a trial, then the most promising one gets the rest.

Where no landing is good, the best of them may lie in a basin whose floor is worse than another's; a search finds out
within some generations (racing: Maron & Moore 1997).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from mjx_fitness import Scores

from mjx_refine.search.landed import Landed, landed_well
from mjx_refine.search.options import Options
from mjx_refine.search.population import PopulationSearch
from mjx_refine.search.problem import Start
from mjx_refine.space import Space

TRIAL = 0.25
"""Part of the rollouts left that each search may spend before they are compared."""

LEAST = 4000
"""Rollouts left below which only the best landing is searched from."""

FINE = 0.33
"""Part of the rollouts left after the landings that is searched at a finer resolution: samples far apart are fitted
beside the pixels between them."""

SETTLED = 0.002
"""Gain of fitness over the last third of a search's generations below which it has settled: what is left of it is polish."""

OPEN = 0.5
"""Spread of the second search's first generation [prior widths]: it has a basin to find, not to follow."""


@dataclasses.dataclass
class Contender:
    """One search of a race.

    Attributes:
      start, space: what it starts from.
      search: the search.
      trail: best fitness after each of its generations.
    """

    start: Start
    space: Space
    search: PopulationSearch
    trail: list[float] = dataclasses.field(default_factory=list)

    @property
    def promise(self) -> float:
        """Fitness so far, and once more what the last third of the generations gained: a search that still climbs beats
        one that has settled a little higher."""
        if not self.trail:
            return -np.inf
        return self.trail[-1] + self._gain

    @property
    def settled(self) -> bool:
        """Whether it gained next to nothing over the last third of its generations."""
        return bool(self.trail) and self._gain < SETTLED

    @property
    def _gain(self) -> float:
        return self.trail[-1] - self.trail[2 * (len(self.trail) - 1) // 3]


class Race:
    """Contenders that share a budget; one of them alone is searched to the end.

    Args:
      contenders: not begun yet.
      evaluations: rollouts spent before.
      fine: whether the last part is searched at a finer resolution, by the most promising one alone.
    """

    def __init__(self, contenders: list[Contender], options: Options, evaluations: int, fine: bool = False):
        self.contenders, self.evaluations = contenders, evaluations
        self._trial = int(TRIAL * (options.budget - evaluations)) if len(contenders) > 1 else 0
        self._fine_from = options.budget - FINE * (options.budget - evaluations) if fine else np.inf

    def turn(self) -> tuple[int, np.ndarray] | None:
        """Whose points are to be evaluated next; None at the end."""
        line = [k for k in self._line() if self.contenders[k].search.reason is None]
        if self.evaluations >= self._fine_from and line:
            line = [self._last(line)]
        for k in line:
            search = self.contenders[k].search
            search.evaluations = self.evaluations
            points = search.points()
            if points is not None:
                return k, points
        return None

    def _line(self) -> list[int]:
        """Those on trial in order, then all by their promise, one that has settled after those that still climb: where a
        search ends early, the next one goes on."""
        numbers = range(len(self.contenders))
        spent = [len(c.trail) * c.search.population for c in self.contenders]
        on_trial = [k for k in numbers if spent[k] < self._trial]
        return on_trial + sorted(numbers, key=lambda k: (self.contenders[k].settled, -self.contenders[k].promise))

    def _last(self, line: list[int]) -> int:
        """Who searches the finer part: the first in line when it begins."""
        for k in line:
            if self.contenders[k].search.fine:
                return k
        self.contenders[line[0]].search.refocus()
        return line[0]

    def told(self, k: int, points: np.ndarray, costs: np.ndarray, scores: Scores) -> bool:
        """Takes the costs and scores of points of contender ``k``; True where that was a generation."""
        contender = self.contenders[k]
        generation = contender.search.told(points, costs, scores)
        self.evaluations = contender.search.evaluations
        if generation:
            contender.trail.append(contender.search.best[0])
        return generation

    @property
    def winner(self) -> int:
        """The contender of the finer part, or else the one that came highest; the first where none began."""
        return max(
            range(len(self.contenders)),
            key=lambda k: (self.contenders[k].search.fine, (self.contenders[k].trail or [-np.inf])[-1]),
        )

    def saved(self) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
        """(values, arrays) for a checkpoint, one search alone as it saves itself; None before the first generation."""
        if len(self.contenders) == 1:
            return self.contenders[0].search.saved()
        values: list[Any] = []
        arrays = {}
        for k, contender in enumerate(self.contenders):
            state = contender.search.saved()
            values.append(None if state is None else {**state[0], "trail": contender.trail})
            arrays.update({} if state is None else {f"search.{k}.{name}": v for name, v in state[1].items()})
        return {"searches": values}, arrays

    def restore(self, values: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Goes on from what ``saved`` returned.

        Raises:
          KeyError, ValueError, TypeError: it is damaged.
        """
        if len(self.contenders) == 1:
            self.contenders[0].search.restore(values, arrays)
            return
        for k, (contender, state) in enumerate(zip(self.contenders, values["searches"], strict=True)):
            if state is not None:
                own = f"search.{k}."
                kept = {name.removeprefix(own): v for name, v in arrays.items() if name.startswith(own)}
                contender.search.restore(state, kept)
                contender.trail = list(state["trail"])


def second_landing(landed: list[Landed], left: int) -> Landed | None:
    """The best landing from another sample than the best one's, where a race is due: no landing is good, and enough
    rollouts are left."""
    if landed_well(landed) or left < LEAST:
        return None
    ranked = sorted(landed, key=lambda landing: -landing.fitness)
    return next((landing for landing in ranked if landing.rank != ranked[0].rank), None)
