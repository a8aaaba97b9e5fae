"""Objects that never meet: one rollout tells derivatives by a number of each (Curtis, Powell and Reid 1974)."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from mjx_refine.diagnosis.hypothesis import Hypothesis
from mjx_refine.sim.model import model_fields

Shot = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Points, one a row, to poses and what paths miss."""


@dataclasses.dataclass(frozen=True)
class Beside:
    """Points beside one at which derivatives are asked for.

    Attributes:
      points: the point itself, and then those beside it.
      poses: of the rollouts there.
      missed: by how much their paths miss the next ones' begin, where there are nodes.
      row: beside which of them each coordinate is moved.
      felt: which objects' residuals each coordinate changes there, and in the last column whether the background's.
    """

    points: Float[np.ndarray, "rows dimension"]
    poses: Float[np.ndarray, "rows frames objects 7"]
    missed: Float[np.ndarray, "rows missed"]
    row: Int[np.ndarray, "dimension"]
    felt: Bool[np.ndarray, "dimension objects_and_background"]

    def change_of_missed(self, owners: Int[np.ndarray, "missed"]) -> Float[np.ndarray, "dimension missed"]:
        """By how much each coordinate changes what paths miss, which are of the objects ``owners``."""
        return np.where(self.felt[:, owners], self.missed[self.row] - self.missed[0], 0.0)


def beside(
    hypothesis: Hypothesis,
    z: Float[np.ndarray, "dimension"],
    step: Float[np.ndarray, "dimension"],
    shot: Shot,
) -> Beside:
    """Points beside ``z``, by a step along each coordinate; of objects that do not meet in any of them, several at once.

    Args:
      hypothesis: whose coordinates they are.
      z: the point.
      step: of each coordinate.
      shot: rollouts at points, one a row, and by how much their paths miss the next ones' begin.
    """
    still, missed = shot(z[None])
    met = _meetings(hypothesis, z[None], still) | hypothesis.couples
    rows = moved_together(hypothesis.owners, companies(met), hypothesis.moves)
    points, poses, away = _rolled(hypothesis, z, rows * step, (still, missed), shot)
    company = companies(met | _meetings(hypothesis, points, poses))
    if len(rows) < len(z) and (company != companies(met)).any():
        rows = moved_together(hypothesis.owners, np.zeros_like(company), hypothesis.moves)
        points, poses, away = _rolled(hypothesis, z, rows * step, (still, missed), shot)
    row = rows.argmax(0)
    alone = rows.sum(1)[row] == 1
    felt = alone[:, None] | (company[hypothesis.owners][:, None] == np.append(company, -1))
    both = [np.concatenate(two) for two in ((z[None], points), (still, poses), (missed, away))]
    return Beside(both[0], both[1], both[2], 1 + row, felt)


def _rolled(hypothesis: Hypothesis, z: np.ndarray, steps: np.ndarray, still: tuple[np.ndarray, np.ndarray], shot: Shot):
    points, (poses, missed) = np.clip(z + steps, *hypothesis.bounds), (np.repeat(s, len(steps), 0) for s in still)
    moves = (steps[:, hypothesis.moves] != 0).any(1)
    if moves.any():
        poses[moves], missed[moves] = shot(points[moves])
    return points, poses, missed


def _meetings(hypothesis: Hypothesis, points: np.ndarray, poses: np.ndarray) -> Bool[np.ndarray, "objects objects"]:
    return meetings(poses, model_fields(hypothesis.batch(points)).geom_rbound)


def meetings(
    poses: Float[np.ndarray, "batch frames objects 7"], radius: Float[np.ndarray, "batch objects"]
) -> Bool[np.ndarray, "objects objects"]:
    """Which two bounding spheres [m] meet in some candidate, in a frame or between two, where paths are taken to be straight."""
    place = poses[..., :3]
    apart = place[:, :, :, None] - place[:, :, None]
    moved = np.diff(apart, axis=1)
    length = np.maximum((moved**2).sum(-1, keepdims=True), 1e-12)
    nearest = np.clip(-(apart[:, :-1] * moved).sum(-1, keepdims=True) / length, 0.0, 1.0)
    between = apart[:, :-1] + nearest * moved
    least = np.linalg.norm(np.concatenate([apart, between], 1), axis=-1).min(1, initial=np.inf)
    return (least < radius[:, :, None] + radius[:, None]).any(0) & ~np.eye(radius.shape[1], dtype=bool)


def companies(met: Bool[np.ndarray, "objects objects"]) -> Int[np.ndarray, "objects"]:
    """The number of each object's company: of all that meet, directly or by others."""
    return np.asarray(connected_components(met, directed=False)[1])


def moved_together(
    owner: Int[np.ndarray, "dimension"], company: Int[np.ndarray, "objects"], moves: Bool[np.ndarray, "dimension"]
) -> Bool[np.ndarray, "rows dimension"]:
    """Which coordinates are moved in each candidate, every one in exactly one.

    Args:
      owner: the object that each coordinate is of; -1: of none alone.
      company: of each object.
      moves: which coordinates change the rollout: those go together, so that few rollouts are needed.
    """
    alone = [[k] for k in np.nonzero(owner < 0)[0]]
    queues = [
        sorted(np.nonzero((owner >= 0) & (company[owner] == c))[0], key=lambda k: not moves[k])
        for c in range(int(company.max()) + 1)
    ]
    rows = alone + [[k for k in row if k is not None] for row in itertools.zip_longest(*queues)]
    told = np.zeros((len(rows), len(owner)), bool)
    for row, columns in zip(told, rows, strict=True):
        row[columns] = True
    return told
