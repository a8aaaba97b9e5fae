"""What the population search minimises: minus the fitness of a candidate's pictures, beside a price for overlaps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Array, Float
from mjx_fitness import Scores

from mjx_refine.batch import SceneBatch
from mjx_refine.sim.backends import Simulator
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space
from mjx_refine.view.grid import GridScorer
from mjx_refine.view.picture_scorer import PictureScorer
from mjx_refine.view.tiles import TileScorer

OVERLAP_ALLOWED = 0.002
"""Overlap of two objects in the first frame that costs nothing [m]: contacts at rest sink in by as much."""

OVERLAP_PRICE = 20.0
"""Fitness that a metre of overlap beyond that costs: MuJoCo throws overlapping objects apart."""


class Objective:
    """Costs of points in the unit box.

    Args:
      space: the parameters.
      simulator: the backend that searches.
      reference: C MuJoCo, for the overlaps at the start.
      scorer: of pictures.
    """

    def __init__(
        self,
        space: Space,
        simulator: Simulator,
        reference: MujocoSimulator,
        scorer: TileScorer | PictureScorer | GridScorer,
    ):
        self.space, self.simulator, self.reference, self.scorer = space, simulator, reference, scorer

    def __call__(self, points: Float[np.ndarray, "batch dimension"]) -> tuple[Float[np.ndarray, "batch"], Scores]:
        """(costs, scores); the cost of a candidate that diverges is inf."""
        batch = self.space.decode(points)
        if isinstance(self.scorer, GridScorer):
            poses = launched(self.simulator, batch, self.scorer.length)
            price = price_of_overlap(self.reference, batch)  # while the device computes
            scores = self.scorer.score(poses(), batch, [len(batch)])[0]
            return price - scores.fitness, scores
        scores = self.scorer(self.simulator.rollout(batch, self.scorer.length), batch)
        return price_of_overlap(self.reference, batch) - scores.fitness, scores


def launched(
    simulator: Simulator, batch: SceneBatch, frames: int
) -> Callable[[], Float[Array | np.ndarray, "rows frames objects 7"]]:
    """Begins a rollout where the simulator can; what is returned waits for its poses, where ``GridScorer.score`` takes them: on
    the simulator's device, where it has one."""
    launch = getattr(simulator, "launch", None)
    if launch is not None and not batch.effects:
        return launch(batch, frames)
    poses = simulator.rollout(batch, frames)
    return lambda: poses


def price_of_overlap(reference: MujocoSimulator, batch: SceneBatch) -> Float[np.ndarray, "batch"]:
    """What each candidate pays for objects that overlap in its first frame."""
    return OVERLAP_PRICE * np.maximum(reference.overlap(batch) - OVERLAP_ALLOWED, 0.0)
