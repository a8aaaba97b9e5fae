"""From which samples least squares lands, and how far each goes: many a little way, few to the end.

Where the first frames of a clip do not fit, its later ones never do: what a landing costs at a short horizon tells the
hopeless ones apart for a thirtieth of its rollouts (successive halving: Jamieson & Talwalkar 2016).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_refine.search.course import Course
from mjx_refine.search.derivatives import Automatic
from mjx_refine.search.landed import LANDED_WELL, Landed
from mjx_refine.search.landing import LeastSquares
from mjx_refine.search.problem import Problem, Start
from mjx_refine.search.schedule import HEATS, Stage, stages
from mjx_refine.space import Space

FIELD = 2
"""Samples in the first heat, for each one that may land."""

WHOLE = 36.0
SECOND_HEAT = 8.0
"""What a whole landing and the second heat cost, in multiples of the first heat: on clips of one to four objects 34 to 45
and 7 to 9 were seen."""

LANDED_WHOLLY = 0.99
"""IoU of a landing after which no other sample lands: what is left is for the population search."""

LANDED_CLEARLY, DEAR = 0.97, 0.1
"""The same where another landing would take more than this part of what landings may spend."""

HOPELESS = 4.0
"""A sample whose cost in a heat is more than so many times the best one's waits for those that are better; a landing
whose cost at a horizon is, is broken off."""

Squares = Callable[[Start, Space], LeastSquares]
Derived = Callable[[Start, Space], Automatic | None]
Shown = Callable[[int, Start, Space, np.ndarray, int], None]


class Landings:
    """The landings of one clip, resumable after each heat and each landing.

    Args:
      problem: samples and observation.
      squares: least squares from a start.
      automatic: derivatives that a landing uses beside differences; heats go by differences alone.
      shown: called with (rollouts so far, start, space, point, frames) after each stage of a landing.
      limit: rollouts that may be spent.

    Attributes:
      landed: those that went to the end.
      evaluations: rollouts so far.
    """

    def __init__(self, problem: Problem, squares: Squares, automatic: Derived, shown: Shown, limit: int):
        self.problem, self.options, self._make, self._shown, self.limit = (
            problem,
            problem.options,
            squares,
            shown,
            limit,
        )
        self._automatic = automatic
        self.schedule = stages(problem.observation.length)
        self.landed: list[Landed] = []
        self.evaluations = 0
        self._courses: dict[int, Course] = {}
        self._prices: dict[int, float] = {}
        self._took: list[int] = []
        self._hopped: list[int] = []
        self._trail: dict[Stage, float] = {}
        self._order: list[int] | None = None
        self._planned = 0

    def __call__(self, keep: Callable[[], None]) -> None:
        """Lands; ``keep`` is called after what should not be lost."""
        if self._order is None:
            self._order = self._heats()
            keep()
        count = self.options.starts
        first = [r for r in self._order[:count] if not self._hopeless(r)]
        rest = [r for r in self._order if r not in first][: 3 * count - len(first)]
        # Where none lands well, again from the best with more attempts at each contact, then from further samples.
        plan = [(r, 0) for r in first] + [(-1, 2)] + [(r, 0) for r in rest] + [(-1, 2)]
        for step, (rank, hops) in enumerate(plan):
            if step < self._planned:
                continue
            done = max((r.iou for r in self.landed), default=0.0)
            if done >= (LANDED_WELL if step >= len(first) else self._enough()):
                break
            if self._took and self.evaluations + np.mean(self._took) > self.limit:
                break
            if rank < 0:
                rank = max(self.landed, key=lambda landed: landed.fitness).rank
                if rank in self._hopped:
                    continue
                self._hopped.append(rank)
            self.landed.append(self._land(rank, hops))
            self._planned = step + 1
            keep()

    def _enough(self) -> float:
        """IoU of a landing after which no other sample lands."""
        dear = self._took and np.mean(self._took) > DEAR * self.limit
        return LANDED_CLEARLY if dear else LANDED_WHOLLY

    # Heats --------------------------------------------------------------------------------------------------------

    def _heats(self) -> list[int]:
        """Ranks of the samples in the order in which they should land."""
        ranks = list(range(len(self.problem.starts)))
        field = ranks[: FIELD * self.options.starts]
        if self.options.starts == 1 or len(field) <= 1:
            return ranks
        self._heat(field, HEATS[0])
        # What is left at so short a horizon is mostly chance, unless it is much.
        bound = self._bound(min(self._prices.values()))
        field.sort(key=lambda rank: max(self._prices[rank], bound))
        each = max(self.evaluations / len(field), 1.0)
        affordable = (self.limit / each - WHOLE - len(field)) / SECOND_HEAT
        second = field[: int(np.clip(round(affordable), 1, self.options.starts))]
        if len(second) > 1:
            self._heat(second, HEATS[1])
            second.sort(key=self._prices.__getitem__)
        return second + [r for r in field if r not in second] + ranks[len(field) :]

    def _heat(self, ranks: list[int], part: float) -> None:
        """Takes samples to a part of the clip, and prices them there."""
        length = self.problem.observation.length
        frames = max(stage.frames for stage in self.schedule if stage.frames <= max(2, round(part * length)))
        stage = Stage(frames, 12.0, 1)
        for rank in ranks:
            start, space, squares = self._at(rank)
            course = squares.follow(self._courses.get(rank, Course(space.start)), self.schedule, frames)
            self._courses[rank] = course
            self._prices[rank] = float(squares.residuals(course.point[None], stage.frames, stage.scale)[1][0])
            self.evaluations += squares.evaluations
            self._shown(self.evaluations, start, space, course.point, frames)

    def _hopeless(self, rank: int) -> bool:
        """Whether a sample's heat was much worse than that of the first in order, which had the same heats or more."""
        if self._order is None or rank not in self._prices:
            return False
        best = self._order[0]
        same = self._courses[rank].stage == self._courses[best].stage
        return same and self._prices[rank] > self._bound(self._prices[best])

    def _bound(self, best: float) -> float:
        """What a sample may cost where the best one costs so much; a frame's noise is let pass."""
        return HOPELESS * best + self.problem.observation.length

    # Landings -----------------------------------------------------------------------------------------------------

    def _at(self, rank: int) -> tuple[Start, Space, LeastSquares]:
        """Least squares from a sample, with what is left to spend."""
        start = self.problem.starts[rank]
        space = Space.around(start.scene)
        squares = self._make(start, space)
        squares.limit = self.limit - self.evaluations
        return start, space, squares

    def _land(self, rank: int, hops: int) -> Landed:
        start, space, squares = self._at(rank)
        squares.automatic = self._automatic(start, space)
        before = self.evaluations

        trail: dict[Stage, float] = {}

        def show(stage: Stage, point: np.ndarray, cost: float) -> bool:
            self.evaluations = before + squares.evaluations
            self._shown(self.evaluations, start, space, point, stage.frames)
            trail[stage] = cost
            return cost <= self._bound(self._trail.get(stage, np.inf))

        # Attempts at contacts are made at every horizon, so they begin with the first.
        course = self._courses.get(rank) if not hops else None
        landing = squares.land(course or Course(space.start), self.schedule, hops, show)
        self.evaluations = before + landing.evaluations
        self._took.append(landing.evaluations)
        scores = self.problem.score([space.scene_at(landing.point)], start.matching)
        landed = Landed(rank, landing.point, landing.covariance, float(scores.fitness[0]), float(scores.iou[0]))
        if landed.fitness > max((other.fitness for other in self.landed), default=-np.inf):
            self._trail = trail
        return landed

    # Checkpoint ---------------------------------------------------------------------------------------------------

    def saved(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """(values, arrays) for a checkpoint."""
        values = {
            "landing": self.evaluations,
            "planned": self._planned,
            "order": self._order,
            "took": self._took,
            "hopped": self._hopped,
            "trail": [[s.frames, s.scale, s.iterations, cost] for s, cost in self._trail.items()],
            "landed": [[r.rank, r.fitness, r.iou] for r in self.landed],
            "courses": [[r, c.cost, c.known, c.stage, self._prices[r]] for r, c in self._courses.items()],
        }
        arrays = {f"course.{r}": c.point for r, c in self._courses.items()}
        for k, r in enumerate(self.landed):
            arrays[f"landed.{k}.point"], arrays[f"landed.{k}.covariance"] = r.point, r.covariance
        return values, arrays

    def restore(self, values: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Goes on from what ``saved`` returned.

        Raises:
          KeyError, ValueError, TypeError: it is damaged.
        """
        self.evaluations = int(values["landing"])
        self._planned, self._order, self._took = values["planned"], values["order"], values["took"]
        self._hopped = values["hopped"]
        self._trail = {Stage(*stage): cost for *stage, cost in values["trail"]}
        for k, (rank, fitness, iou) in enumerate(values["landed"]):
            point, covariance = arrays[f"landed.{k}.point"], arrays[f"landed.{k}.covariance"]
            self.landed.append(Landed(rank, point, covariance, fitness, iou))
        for rank, cost, known, stage, price in values["courses"]:
            self._courses[rank] = Course(arrays[f"course.{rank}"], cost, known, stage)
            self._prices[rank] = price
