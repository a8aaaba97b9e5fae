"""What one refinement minimises and looks at, where it is computed."""

from __future__ import annotations

import contextlib

import numpy as np
from jaxtyping import Float
from mjx_fitness import Scores

from mjx_refine.effects import batch_with_effects
from mjx_refine.search.aim import aimed
from mjx_refine.search.engines import Engines
from mjx_refine.search.objective import Objective
from mjx_refine.search.options import search_resolution
from mjx_refine.search.problem import Problem, Start
from mjx_refine.sim.backends import Simulator
from mjx_refine.sim.devices import has_accelerator, on_device
from mjx_refine.space import Space
from mjx_refine.view.effects import needs_pictures
from mjx_refine.view.grid import GridScorer, sampled


class Objectives:
    """Objectives of one refinement's starts.

    Args:
      problem: the clip, its options and C MuJoCo.
      engines: of the refinement.
    """

    def __init__(self, problem: Problem, engines: Engines):
        self.problem, self.options, self.engines = problem, problem.options, engines
        self._grids: dict[tuple, GridScorer] = {}

    @property
    def finer(self) -> bool:
        """Whether the search ends at a finer resolution: not at a user's own, nor on a device, which would compile anew."""
        hybrid = self.options.optimizer == "hybrid" and self.options.resolution is None
        return hybrid and not has_accelerator()

    def of(self, start: Start, space: Space, simulator: Simulator | None = None, fine: bool = False) -> Objective:
        """What a search minimises; ``simulator``: that searches, C MuJoCo if None; ``fine``: in its last part."""
        reference, size = self.problem.reference(start.scene.shapes), self.problem.observation.size
        pictures = needs_pictures(batch_with_effects([start.scene]))
        if simulator is not None and not pictures and has_accelerator():
            return Objective(space, simulator, reference, self._grid(start))
        resolution = search_resolution(self.options, size, fine)
        scorer = self.problem.scorer(start.scene.shapes, start.matching, resolution, pictures)
        return Objective(space, simulator or reference, reference, scorer)

    def glance(
        self, start: Start, space: Space, point: Float[np.ndarray, "dimension"]
    ) -> tuple[Float[np.ndarray, "1"], Scores]:
        """(cost, scores) of one point."""
        with self._place(start, space):
            return self._between(start, space)(point[None])

    def aimed(self, start: Start, space: Space, point: Float[np.ndarray, "dimension"]) -> np.ndarray:
        """The point as ``aim.aimed`` leaves it, in a hybrid search."""
        if self.options.optimizer != "hybrid":
            return point
        key = ("aimed", start.index, point.tobytes())
        if key not in self.problem.kept:
            with self._place(start, space):
                seen = self._between(start, space, fine=self.finer)
                self.problem.kept[key] = aimed(space, point, seen.simulator, seen.scorer, self.options.seed)
        return self.problem.kept[key]

    def _between(self, start: Start, space: Space, fine: bool = False) -> Objective:
        """Of few candidates between searches: on the device where least squares is there too."""
        if not self.engines.on_device(start.scene, space.dimension):
            return self.of(start, space, fine=fine)
        return self.of(start, space, self.engines.quick("warp", start.scene.shapes))

    def _place(self, start: Start, space: Space) -> contextlib.AbstractContextManager[None]:
        return on_device() if self.engines.on_device(start.scene, space.dimension) else contextlib.nullcontext()

    def _grid(self, start: Start) -> GridScorer:
        """Pictures on the device."""
        key = start.scene.shapes, start.matching
        if key not in self._grids:
            resolution = search_resolution(self.options, self.problem.observation.size)
            clip = sampled(self.problem.observation, start.matching, resolution)
            self._grids[key] = GridScorer(start.scene.shapes, [clip], [self.options.weights])
        return self._grids[key]
