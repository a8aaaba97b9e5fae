"""Which numbers share a rollout that tells derivatives: those of objects that never meet, and those of stretches of a path that
nodes keep apart, since what one changes the other does not (Curtis, Powell and Reid 1974)."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from mjx_refine.batch import SceneBatch
from mjx_refine.diagnosis.fits.hypothesis import WHOLE, Hypothesis
from mjx_refine.diagnosis.fits.nodes import missed_by
from mjx_refine.sim.model import model_fields

Flight = tuple[Float[np.ndarray, "rows frames objects 7"], Float[np.ndarray, "rows nodes 13"]]
"""Poses, and the states in which paths arrive at nodes."""

Fly = Callable[[SceneBatch], Flight]
"""Candidates to what is simulated of them."""


@dataclasses.dataclass(frozen=True)
class Beside:
    """Points beside one at which derivatives are asked for.

    Attributes:
      batch: the candidate at the point itself, and then those beside it.
      poses: of their rollouts.
      missed: by how much their paths miss the next ones' begin, where there are nodes.
      row: beside which of them each coordinate is moved.
      felt: which objects' residuals each coordinate changes there, and in the last column whether the background's.
    """

    batch: SceneBatch
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
    fly: Fly,
) -> Beside:
    """Points beside ``z``, by a step along each coordinate; of objects that do not meet in any of them, several at once.

    Args:
      hypothesis: whose coordinates they are.
      z: the point.
      step: of each coordinate.
      fly: simulates candidates.
    """
    here = hypothesis.batch(z[None])
    still = fly(here)
    met = _meetings(here, still[0]) | hypothesis.couples
    rows, shared = _shared(hypothesis, companies(met))
    batch, flown = _flown(hypothesis, z, shared * step, still, fly)
    company = companies(met | _meetings(batch, flown[0]))
    if len(shared) < len(z) and (company != companies(met)).any():
        rows, shared = _shared(hypothesis, np.zeros_like(company))
        batch, flown = _flown(hypothesis, z, shared * step, still, fly)
        company = np.zeros_like(company)
    if shared is not rows:
        batch = _stepped(hypothesis, z, rows * step)
        flown = _told_apart(hypothesis, company, rows, shared, still, flown)
    row = rows.argmax(0)
    alone = rows.sum(1)[row] == 1
    felt = alone[:, None] | (company[hypothesis.owners][:, None] == np.append(company, -1))
    poses, arrived = (np.concatenate(two) for two in zip(still, flown, strict=True))
    return Beside(batch, poses, missed_by(hypothesis.nodes, arrived, batch.restarts), 1 + row, felt)


def _shared(hypothesis: Hypothesis, company: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which coordinates are moved at each point at which residuals are asked for, and which in each rollout."""
    owners, moves = hypothesis.owners, hypothesis.moves
    whole = np.full(len(owners), WHOLE)
    rows = moved_together(owners, company, moves, whole)
    # What is shown twice may be of two stretches.
    if not hypothesis.nodes or any(t.kind.retimes for t in hypothesis.terms):
        return rows, rows
    return rows, moved_together(owners, company, moves, _stretches(hypothesis, company))


def _stretches(hypothesis: Hypothesis, company: np.ndarray) -> np.ndarray:
    """``Hypothesis.stretches`` of objects that meet no other; what others meet changes their paths, too."""
    return np.where(np.bincount(company)[company][hypothesis.owners] == 1, hypothesis.stretches, WHOLE)


def _stepped(hypothesis: Hypothesis, z: np.ndarray, steps: np.ndarray) -> SceneBatch:
    """The candidate at ``z``, and those a step away."""
    return hypothesis.batch(np.clip(z + np.concatenate([0 * steps[:1], steps]), *hypothesis.bounds))


def _flown(
    hypothesis: Hypothesis, z: np.ndarray, steps: np.ndarray, still: Flight, fly: Fly
) -> tuple[SceneBatch, Flight]:
    """``_stepped``, and what is simulated a step away; where a step changes only what is seen, it is as at ``z``."""
    batch, (poses, arrived) = _stepped(hypothesis, z, steps), (np.repeat(s, len(steps), 0) for s in still)
    moves = (steps[:, hypothesis.moves] != 0).any(1)
    if moves.any():
        poses[moves], arrived[moves] = fly(batch[1:][moves])
    return batch, (poses, arrived)


def _told_apart(
    hypothesis: Hypothesis, company: np.ndarray, rows: np.ndarray, shared: np.ndarray, still: Flight, flown: Flight
) -> Flight:
    """What would have been simulated at points where coordinates are moved as in ``rows``, from rollouts in which more were."""
    owners, stretches, nodes = hypothesis.owners, _stretches(hypothesis, company), hypothesis.nodes
    poses, arrived = (np.repeat(s, len(rows), 0) for s in still)
    for coordinate, (row, rollout) in enumerate(zip(rows.argmax(0), shared.argmax(0), strict=True)):
        owner = owners[coordinate]
        felt = company == company[owner] if owner >= 0 else np.ones(len(company), bool)
        begin, end = hypothesis.frames_of(owner, stretches[coordinate], poses.shape[1])
        poses[row, begin:end, felt] = flown[0][rollout, begin:end, felt]
        ends = [k for k, node in enumerate(nodes) if felt[node.target] and begin < node.frame <= end]
        arrived[row, ends] = flown[1][rollout, ends]
    return poses, arrived


def _meetings(batch: SceneBatch, poses: np.ndarray) -> Bool[np.ndarray, "objects objects"]:
    return meetings(poses, model_fields(batch).geom_rbound[-len(poses) :])


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
    owner: Int[np.ndarray, "dimension"],
    company: Int[np.ndarray, "objects"],
    moves: Bool[np.ndarray, "dimension"],
    stretch: Int[np.ndarray, "dimension"],
) -> Bool[np.ndarray, "rows dimension"]:
    """Which coordinates are moved in each candidate, every one in exactly one.

    Args:
      owner: the object that each coordinate is of; -1: of none alone.
      company: of each object.
      moves: which coordinates change the rollout: those go together, so that few rollouts are needed.
      stretch: of its object's path that each coordinate changes alone, several of which go together; ``WHOLE``: all of it.
    """
    rows = [[k] for k in np.nonzero(owner < 0)[0]]
    queues: list[list[list[int]]] = []
    for c in range(int(company.max()) + 1):
        mine = sorted(np.nonzero((owner >= 0) & (company[owner] == c))[0], key=lambda k: not moves[k])
        parts = [[k for k in mine if stretch[k] == part] for part in range(int(stretch.max(initial=WHOLE)) + 1)]
        queues.append(
            sorted(_side_by_side(parts) + [[k] for k in mine if stretch[k] == WHOLE], key=lambda r: not moves[r[0]])
        )
    rows += [[k for part in row for k in part] for row in _side_by_side(queues)]
    told = np.zeros((len(rows), len(owner)), bool)
    for row, columns in zip(told, rows, strict=True):
        row[columns] = True
    return told


def _side_by_side(queues: list[list[Any]]) -> list[list[Any]]:
    """The first of each, the second of each that has one, ..."""
    return [[one for one in row if one is not None] for row in itertools.zip_longest(*queues)]
