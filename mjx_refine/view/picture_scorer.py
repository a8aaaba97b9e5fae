"""Scores of candidates whose effects change how they are seen: every picture is drawn."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from mjx_fitness import Scores, Sums, Weights, picture_sums, scores_from_sums

from mjx_refine.batch import SceneBatch
from mjx_refine.observation import Observation
from mjx_refine.scene import Shape
from mjx_refine.view.effects import BLOCK, draw_effects, render
from mjx_refine.view.tiles import foreground


class PictureScorer:
    """``TileScorer`` for scenes with effects; slower.

    At a coarse resolution masks are widened outline by outline, so that where one object hides another the edge between
    them moves too; at the full one as ``draw_effects`` does.

    Args:
      shapes: the scene kind.
      observation: what was seen; without masks its moving region is the foreground.
      matching: for each object its mask's id, or ``UNMATCHED``.
      resolution: (width, height) of the samples, every one a pixel of the full picture; None: all.
      weights: of the fitness.
    """

    def __init__(
        self,
        shapes: tuple[Shape, ...],
        observation: Observation,
        matching: tuple[int, ...],
        resolution: tuple[int, int] | None = None,
        weights: Weights | None = None,
    ):
        self.shapes, self.matching, self.weights = shapes, matching, weights or Weights()
        self.image, self.length, self.fps = observation.size, observation.length, observation.fps
        self.moving_only = observation.masks is None
        width, height = resolution or self.image
        self.resolution = (min(width, self.image[0]), min(height, self.image[1]))
        self._columns, self._rows = (
            np.floor((np.arange(wanted) + 0.5) * full / wanted).astype(int)
            for wanted, full in zip(self.resolution, self.image, strict=True)
        )
        self._masks = foreground(observation)[:, self._rows][:, :, self._columns]
        self._flow = observation.flow[:, self._rows][:, :, self._columns]

    def __call__(self, poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch) -> Scores:
        """Scores of every candidate; a candidate whose poses are not finite has fitness -inf and IoU 0."""
        bad = np.logical_not(np.isfinite(poses).all((1, 2, 3)))
        poses = np.where(bad[:, None, None, None], [0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 0.0], poses)
        sums: list[Sums] = []
        if self.resolution == self.image:
            for row in range(len(batch)):
                sums.append(self._sums(*draw_effects(poses[row], batch, self.image, self.fps, row)))
        else:
            size = max(1, BLOCK // (self.length * self._masks[0].size))
            for first in range(0, len(batch), size):
                # One length is compiled.
                rows = np.minimum(np.arange(first, first + size), len(batch) - 1)
                grid = (self._columns + 0.5, self._rows + 0.5)
                ids, flow = render(
                    poses[rows], batch[rows], *grid, self.image, self.fps, slice(0, self.length), widened=True
                )
                sums += [self._sums(ids[k], flow[k, :-1]) for k in range(min(size, len(batch) - first))]
        fields = [f.name for f in dataclasses.fields(Sums)]
        together = Sums(**{name: np.concatenate([getattr(one, name) for one in sums]) for name in fields})
        scores = scores_from_sums(together, self.weights)
        fitness = np.where(bad, -np.inf, scores.fitness)
        return dataclasses.replace(scores, fitness=fitness, iou=np.where(bad, 0.0, scores.iou))

    def _sums(self, masks: np.ndarray, flow: np.ndarray) -> Sums:
        if self.moving_only:
            moving = (flow.astype(np.float64) ** 2).sum(-1) > 0.25
            masks = masks * np.concatenate([moving, np.zeros_like(moving[:1])])
        return picture_sums(masks, flow, self._masks, self._flow, self.matching)
