"""What simulates which part of a refinement."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mjx_refine.batch import SceneBatch
from mjx_refine.scene import Scene, Shape
from mjx_refine.search.features import POINTS
from mjx_refine.search.problem import Problem
from mjx_refine.sim.backends import Simulator, fastest, make_simulator
from mjx_refine.sim.devices import on_device
from mjx_refine.sim.fused import LARGEST
from mjx_refine.view.at_once import reach_and_flow
from mjx_refine.view.seen import Look, seen_reach_and_flow


class Engines:
    """The simulators of one refinement, each made once.

    Args:
      problem: the clip, its options and C MuJoCo.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self._made: dict[tuple[str, tuple[Shape, ...]], Simulator] = {}

    def quick(self, backend: str, shapes: tuple[Shape, ...]) -> Simulator:
        """A search's, of a backend."""
        key = backend, shapes
        if key not in self._made:
            self._made[key] = make_simulator(backend, shapes, self.problem.observation.fps, quick=True)
        return self._made[key]

    def rollout(self, scene: Scene, candidates: int) -> Callable[[SceneBatch, int], np.ndarray]:
        """Least squares', whose Jacobians are so many candidates: C MuJoCo, or where that is faster the kernel of whole rollouts.

        One engine makes all rollouts of a fit: costs of two do not compare.
        """
        if not self.on_device(scene, candidates):
            return self.problem.reference(scene.shapes).rollout
        return on_device()(self.quick("warp", scene.shapes).rollout)

    def look(self, scene: Scene, candidates: int) -> Look:
        """What tells least squares what is seen of these rollouts: whoever makes them."""
        return on_device()(_at_once) if self.on_device(scene, candidates) else seen_reach_and_flow

    def on_device(self, scene: Scene, candidates: int) -> bool:
        """Whether a GPU makes these rollouts."""
        shapes, name = scene.shapes, self.problem.options.backend
        return not scene.effects and len(shapes) <= LARGEST and fastest(name, candidates, len(shapes)) == "warp"


def _at_once(
    poses: np.ndarray,
    batch: SceneBatch,
    pixels: np.ndarray | None,
    image: tuple[int, int],
    count: int,
    fps: float,
) -> tuple[np.ndarray, np.ndarray | None]:
    """``seen_reach_and_flow`` of scenes without effects, in one program: a flow that nobody asks for costs nothing beside."""
    somewhere = np.zeros((*poses.shape[1:3], POINTS, 2)) if pixels is None else pixels
    reach, flow = reach_and_flow(poses, batch, somewhere, image, count)
    return reach, None if pixels is None else flow
