"""Samples of one clip, each judged by its pictures and, where its objects are the right ones, by its parameters."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from mjx_refine.observation import Observation
from mjx_refine.scene import SHAPES, Body, Samples, Scene
from mjx_refine.search.options import Options
from mjx_refine.search.problem import Problem

METRICS = (
    "composition", "iou", "first_frame_iou", "epe", "first_frame_epe", "position", "velocity", "damping",
    "sliding_friction", "rolling_friction",
)  # fmt: skip
"""What a sample is judged by, in the order of tables."""


@dataclasses.dataclass(frozen=True)
class Judged:
    """How good one sample is.

    Attributes:
      index: in its file (from 0).
      composition: 1 where it has as many objects of each shape as the truth, else 0.
      iou: mean over frames of the foreground's IoU; 0 for a sample that cannot be read.
      first_frame_iou: ditto, of the first frame.
      epe: end-point error of the whole sequence [px]; NaN for a sample that cannot be read.
      first_frame_epe: ditto, of the first interval [px].
      position: mean absolute error over objects and axes [m]; this and the rest are NaN where the composition is wrong.
      velocity: ditto, of linear velocity [m/s].
      damping: ditto [1/s].
      sliding_friction: ditto [1].
      rolling_friction: ditto [m].
    """

    index: int
    composition: float = 0.0
    iou: float = 0.0
    first_frame_iou: float = 0.0
    epe: float = math.nan
    first_frame_epe: float = math.nan
    position: float = math.nan
    velocity: float = math.nan
    damping: float = math.nan
    sliding_friction: float = math.nan
    rolling_friction: float = math.nan

    @property
    def fitness(self) -> float:
        """IoU - EPE, by which samples are ranked; minus infinity where it was not read."""
        return self.iou - self.epe if math.isfinite(self.epe) else -math.inf


def paired(scene: Scene, truth: Scene) -> list[tuple[Body, Body]] | None:
    """Objects of ``scene`` with those of ``truth``, of equal shapes and with the least sum of distances at the start; None
    where the numbers of some shape differ."""
    if Counter(scene.shapes) != Counter(truth.shapes):
        return None
    pairs = []
    for shape in SHAPES:
        ours, theirs = ([body for body in s.objects if body.shape == shape] for s in (scene, truth))
        costs = np.array([[math.dist(a.position, b.position) for b in theirs] for a in ours]).reshape(
            len(ours), len(theirs)
        )
        rows, columns = linear_sum_assignment(costs)
        pairs += [(ours[i], theirs[j]) for i, j in zip(rows, columns, strict=True)]
    return pairs


def judge_samples(samples: Samples, truth: Scene, observation: Observation) -> list[Judged]:
    """Judges all samples, in the file's order; those that could not be read have an IoU of 0.

    Raises:
      InputError: an effect of a sample is wrong.
    """
    starts = Problem(samples, observation, Options()).starts
    judged = [Judged(problem.index) for problem in samples.problems]
    for start in starts:
        scores = start.scores
        judged.append(
            Judged(
                index=start.index,
                iou=float(scores.iou[0]),
                first_frame_iou=float(scores.first_frame_iou[0]),
                epe=float(scores.epe[0]),
                first_frame_epe=float(scores.first_frame_epe[0]),
                **_errors(start.given, truth),
            )
        )
    return sorted(judged, key=lambda one: one.index)


def _errors(scene: Scene, truth: Scene) -> dict[str, float]:
    pairs = paired(scene, truth)
    if pairs is None:
        return {}

    def mean(value) -> float:
        return float(np.mean([np.abs(np.subtract(value(a), value(b))) for a, b in pairs]))

    return {
        "composition": 1.0,
        "position": mean(lambda body: body.position),
        "velocity": mean(lambda body: body.linear_velocity),
        "damping": mean(lambda body: body.damping),
        "sliding_friction": mean(lambda body: body.friction[0]),
        "rolling_friction": mean(lambda body: body.friction[1]),
    }


def best_of(judged: Sequence[Judged], count: int) -> Judged:
    """The sample with the best IoU - EPE of the first ``count``; of equal ones the first."""
    return max(judged[:count], key=lambda one: (one.fitness, -one.index))
