"""A refinement's input, made ready: samples of any kind, separated, matched to the masks and scored."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from typing import Any

import numpy as np
from jaxtyping import Float
from mjx_fitness import UNMATCHED, Scores

from mjx_refine.batch import SceneBatch
from mjx_refine.effects import acting, batch_with_effects
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Samples, Scene, Shape
from mjx_refine.search.features import Outlines, flow_points, outlines
from mjx_refine.search.matching import frames_to_match, match_objects
from mjx_refine.search.options import Options
from mjx_refine.sim.backends import backend_for
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.separate import separate
from mjx_refine.space.floor import levelled, tilted
from mjx_refine.view.effects import needs_pictures
from mjx_refine.view.picture_scorer import PictureScorer
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

    @property
    def object_iou(self) -> Float[np.ndarray, "objects"]:
        """IoU of each object with its own mask, 0 of one without."""
        has_mask = np.array(self.matching) != UNMATCHED
        return np.where(has_mask, np.nan_to_num(self.scores.object_iou[0]), 0.0)


class Problem:
    """Samples and an observation.

    Args:
      samples: starting scenes; they may differ in kind.
      observation: the clip.
      options: weights, threads.

    Attributes:
      kept: what was found out about it, for whoever asks again.

    Raises:
      InputError: an effect of a scene is wrong, or the backend cannot carry it.
    """

    def __init__(self, samples: Samples, observation: Observation, options: Options):
        self.samples, self.observation, self.options = samples, observation, options
        self._simulators: dict[tuple[Shape, ...], MujocoSimulator] = {}
        self._scorers: dict[tuple, TileScorer | PictureScorer] = {}
        self.kept: dict[tuple, Any] = {}
        self.backends = _backends(samples, options.backend)
        masks = foreground(observation)
        self.seen: Outlines = outlines(masks)
        self.flow = flow_points(masks, observation.flow, self.seen.ids)
        first, *others = self._ranked()
        # In single precision a score's last digits depend on how many share a call, and results are compared with this.
        alone = self.score([first.given], first.matching)
        self.starts = [dataclasses.replace(first, scores=alone), *others]

    def reference(self, shapes: tuple[Shape, ...]) -> MujocoSimulator:
        """C MuJoCo for a scene kind."""
        if shapes not in self._simulators:
            self._simulators[shapes] = MujocoSimulator(shapes, self.observation.fps, self.options.threads)
        return self._simulators[shapes]

    def as_seen(self, shapes: tuple[Shape, ...]) -> Seen:
        """C MuJoCo, with poses as the still camera would see them."""
        return Seen(self.reference(shapes))

    def scorer(
        self,
        shapes: tuple[Shape, ...],
        matching: tuple[int, ...],
        resolution: tuple[int, int] | None = None,
        pictures: bool = False,
    ) -> TileScorer | PictureScorer:
        """The scorer at a resolution, full if None; ``pictures``: of scenes whose effects change what is seen."""
        key = (shapes, matching, resolution, pictures)
        if key not in self._scorers:
            made = PictureScorer if pictures else TileScorer
            self._scorers[key] = made(shapes, self.observation, matching, resolution, self.options.weights)
        return self._scorers[key]

    def score(
        self, scenes: list[Scene], matching: tuple[int, ...], resolution: tuple[int, int] | None = None
    ) -> Scores:
        """Scores of scenes of one kind at a resolution, full if None, simulated by C MuJoCo."""
        batch = batch_with_effects(scenes)
        poses = self.reference(batch.shapes).rollout(batch, self.observation.length)
        return self.scorer(batch.shapes, matching, resolution, needs_pictures(batch))(poses, batch)

    def columns(self, matching: tuple[int, ...]) -> tuple[int, ...]:
        """For each object the column of ``seen`` that it is matched to, or -1."""
        return tuple(-1 if i == UNMATCHED else self.seen.ids.index(i) for i in matching)

    def _ranked(self) -> list[Start]:
        """All samples, best fitness first."""
        kinds: dict[tuple, list[int]] = defaultdict(list)
        for row, scene in enumerate(self.samples.scenes):
            kinds[kind_of_scene(scene)].append(row)
        starts = []
        for (shapes, *_), rows in kinds.items():
            simulator = self.reference(shapes)
            separated = [_separated(self.samples.scenes[row], simulator) for row in rows]
            batch = batch_with_effects([scene for scene, _ in separated])
            poses = self.as_seen(shapes).rollout(batch, frames_to_match(self.seen))
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


def _backends(samples: Samples, name: str) -> dict[tuple, str]:
    """The backend that searches scenes of each kind; wrong effects are told here, before anything is compiled."""
    result = {}
    for index, scene in zip(samples.indices, samples.scenes, strict=True):
        try:
            result[kind_of_scene(scene)] = backend_for(name, batch_with_effects([scene]))
        except InputError as error:
            if not scene.effects:
                raise
            raise InputError(f"{samples.source}: sample {index}: {error}") from error
    return result


@dataclasses.dataclass(frozen=True)
class Seen:
    """Rollouts as the still camera would see them, for what looks at outlines and knows nothing of effects."""

    simulator: MujocoSimulator

    @property
    def fps(self) -> float:
        return self.simulator.fps

    def rollout(self, batch: SceneBatch, frames: int) -> Float[np.ndarray, "batch frames objects 7"]:
        """Poses at the start of every frame; NaN from where a candidate diverged."""
        poses = self.simulator.rollout(batch, frames)
        return acting.apparent(poses, batch, self.fps) if batch.effects else poses


def kind_of_scene(scene: Scene) -> tuple:
    """Scenes of one kind can be one batch: (shapes, effects, their targets and the lengths of their series)."""
    effects = tuple(
        (e.effect, e.target, tuple((k, len(v)) for k, v in e.parameters if isinstance(v, tuple))) for e in scene.effects
    )
    return scene.shapes, effects


def _separated(scene: Scene, simulator: MujocoSimulator) -> tuple[Scene, float]:
    """``separate``, from a tilted floor too."""
    flat = levelled(scene)
    apart, moved = separate(flat, simulator)
    return (tilted(apart), moved) if moved else (scene, moved)
