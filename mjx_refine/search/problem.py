"""A refinement's input, made ready: samples of any kind, separated, matched to the masks and scored."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

from mjx_fitness import UNMATCHED, Scores

from mjx_refine.batch import batch_from_scenes
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Samples, Scene, Shape
from mjx_refine.search.features import Outlines, flow_points, outlines
from mjx_refine.search.matching import match_objects
from mjx_refine.search.options import Options
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.separate import separate
from mjx_refine.view.tiles import TileScorer, foreground


@dataclasses.dataclass(frozen=True)
class Start:
    """One sample, ready to be refined.

    Attributes:
      index: in the file.
      given: as the file has it.
      scene: with overlapping objects pushed apart.
      moved: how far the farthest was pushed [m].
      matching: for each object its mask's id, or ``UNMATCHED``.
      scores: of ``given``, full resolution (batch 1).
    """

    index: int
    given: Scene
    scene: Scene
    moved: float
    matching: tuple[int, ...]
    scores: Scores

    @property
    def fitness(self) -> float:
        return float(self.scores.fitness[0])


class Problem:
    """Samples and an observation.

    Args:
      samples: starting scenes; they may differ in kind.
      observation: the clip.
      options: weights, threads.

    Raises:
      InputError: a scene has effects, or nothing can be scored.
    """

    def __init__(self, samples: Samples, observation: Observation, options: Options):
        self.samples, self.observation, self.options = samples, observation, options
        self._simulators: dict[tuple[Shape, ...], MujocoSimulator] = {}
        self._scorers: dict[tuple, TileScorer] = {}
        for index, scene in zip(samples.indices, samples.scenes, strict=True):
            if scene.effects:
                raise InputError(
                    f"{samples.source}: sample {index} has an effect ({scene.effects[0].effect}); this version "
                    "simulates the base model alone; remove the entries of type effect"
                )
        masks = foreground(observation)
        self.seen: Outlines = outlines(masks)
        self.flow = flow_points(masks, observation.flow, self.seen.ids)
        self.starts = self._ranked()

    def reference(self, shapes: tuple[Shape, ...]) -> MujocoSimulator:
        """C MuJoCo for a scene kind."""
        if shapes not in self._simulators:
            self._simulators[shapes] = MujocoSimulator(shapes, self.observation.fps, self.options.threads)
        return self._simulators[shapes]

    def scorer(
        self, shapes: tuple[Shape, ...], matching: tuple[int, ...], resolution: tuple[int, int] | None = None
    ) -> TileScorer:
        """The scorer at a resolution, full if None."""
        key = (shapes, matching, resolution)
        if key not in self._scorers:
            self._scorers[key] = TileScorer(shapes, self.observation, matching, resolution, self.options.weights)
        return self._scorers[key]

    def score(self, scenes: list[Scene], matching: tuple[int, ...]) -> Scores:
        """Full-resolution scores of scenes of one kind, simulated by C MuJoCo."""
        batch = batch_from_scenes(scenes)
        poses = self.reference(batch.shapes).rollout(batch, self.observation.length)
        return self.scorer(batch.shapes, matching)(poses, batch)

    def columns(self, matching: tuple[int, ...]) -> tuple[int, ...]:
        """For each object the column of ``seen`` that it is matched to, or -1."""
        return tuple(-1 if i == UNMATCHED else self.seen.ids.index(i) for i in matching)

    def _ranked(self) -> list[Start]:
        """All samples, best fitness first."""
        kinds: dict[tuple[Shape, ...], list[int]] = defaultdict(list)
        for row, scene in enumerate(self.samples.scenes):
            kinds[scene.shapes].append(row)
        starts = []
        for shapes, rows in kinds.items():
            simulator = self.reference(shapes)
            separated = [separate(self.samples.scenes[row], simulator) for row in rows]
            batch = batch_from_scenes([scene for scene, _ in separated])
            poses = simulator.rollout(batch, min(3, self.observation.length))
            groups: dict[tuple[int, ...], list[int]] = defaultdict(list)
            for k in range(len(rows)):
                groups[match_objects(poses[k], batch, k, self.seen, self.observation.size)].append(k)
            for matching, members in groups.items():
                scores = self.score([self.samples.scenes[rows[k]] for k in members], matching)
                for i, k in enumerate(members):
                    given, (scene, moved) = self.samples.scenes[rows[k]], separated[k]
                    starts.append(
                        Start(self.samples.indices[rows[k]], given, scene, moved, matching, scores.candidate(i))
                    )
        return sorted(starts, key=lambda start: (-start.fitness, start.index))
