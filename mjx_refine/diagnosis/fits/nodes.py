"""Multiple shooting: after an impact an object goes on from a state of its own, which its path need only nearly reach.

No two engines agree about an impact, and bodies that tumble soon are elsewhere altogether: derivatives through impacts lead
least squares into whichever of many hollows is nearest, and ordinary numbers bend to what two engines' bounces differ by. With a
state of its own after each impact every stretch of a path is smooth in all numbers, and where one stretch ends and the next
begins may differ by what impacts may err by (Bock and Plitt 1984; Voss, Timmer and Kurths 2004).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from mjx_refine import rotations
from mjx_refine.batch import Restart, SceneBatch
from mjx_refine.diagnosis.fits.slack import PART, Impact
from mjx_refine.diagnosis.seen.noise import BLUR
from mjx_refine.search.residuals import slowed

COORDINATES = 12
"""Of a state: position, turn, velocity, spin, in the world's axes."""

WIDTH = np.repeat([0.03, 0.15, 0.4, 1.5], 3)
"""Units in which a state is fitted [m, rad, m/s, rad/s]."""

LEAST = np.repeat([0.002, 0.01, 0.01, 0.03], 3)
"""What a path may miss the next one's begin by at least, beside what impacts err by, in the same units. Like the other constants
here but HELD, chosen before the first fit with nodes, and not since."""

FORGIVEN = 2.0
"""Deviations beyond which missing the next path's begin costs ever less: a tumbling body may go anywhere."""

LEAST_LEFT = 4
"""Frames that must be left after a node."""

HELD = 1e-3
"""Slope of a coordinate's prior, in its units: hardly any, since what is missed costs."""


@dataclasses.dataclass(frozen=True)
class Node:
    """Where an object goes on from a state of its own.

    Attributes:
      target: index of the object.
      frame: in which it has that state.
      state: around which it is fitted: position, quaternion, velocity and spin, world frame.
      sigma: standard deviations of what the path before may miss it by.
      struck: the impacts before it.
    """

    target: int
    frame: int
    state: Float[np.ndarray, "13"]
    sigma: Float[np.ndarray, "12"]
    struck: tuple[Impact, ...]

    def restart(self, z: Float[np.ndarray, "batch 12"]) -> Restart:
        """The states at ``z``, in units of ``WIDTH`` from ``state``."""
        step = z * WIDTH
        turn = rotations.exponential(step[:, 3:6])
        quaternion = rotations.normalise(rotations.multiply(turn, np.broadcast_to(self.state[3:7], turn.shape)))
        spin = rotations.rotate(rotations.conjugate(quaternion), self.state[10:] + step[:, 9:])
        place, velocity = self.state[:3] + step[:, :3], self.state[7:10] + step[:, 6:9]
        return Restart(self.frame, self.target, np.concatenate([place, quaternion, velocity, spin], 1))

    def missed(
        self, arrived: Float[np.ndarray, "batch 13"], begun: Float[np.ndarray, "batch 13"]
    ) -> Float[np.ndarray, "batch 12"]:
        """By how much paths miss the next ones' begin, robust, in deviations; zero where they do not get there."""
        turn = rotations.multiply(arrived[:, 3:7], rotations.conjugate(begun[:, 3:7]))
        turn = 2.0 * turn[:, 1:] * np.where(turn[:, :1] < 0, -1.0, 1.0)
        spins = [rotations.rotate(one[:, 3:7], one[:, 10:]) for one in (arrived, begun)]
        away = [arrived[:, :3] - begun[:, :3], turn, arrived[:, 7:10] - begun[:, 7:10], spins[0] - spins[1]]
        return slowed(np.nan_to_num(np.concatenate(away, 1)) / self.sigma, FORGIVEN)

    @property
    def price(self) -> float:
        """Logarithm of what is allowed, in the coordinates' units."""
        return float(np.log(self.sigma / WIDTH).sum())


def missed_by(
    nodes: Sequence[Node], arrived: Float[np.ndarray, "batch nodes 13"], begun: Sequence[Restart]
) -> Float[np.ndarray, "batch missed"]:
    """``Node.missed`` of all, side by side."""
    each = enumerate(zip(nodes, begun, strict=True))
    told = [node.missed(arrived[:, k], one.state) for k, (node, one) in each]
    return np.concatenate(told, 1) if told else np.zeros((len(arrived), 0))


def missing(nodes: Sequence[Node]) -> Int[np.ndarray, "missed"]:
    """The object that each number of ``missed_by`` is of."""
    return np.array([node.target for node in nodes for _ in range(COORDINATES)], int)


def nodes_of(
    batch: SceneBatch,
    poses: Float[np.ndarray, "frames objects 7"],
    velocity: Float[np.ndarray, "frames objects 3"],
    spin: Float[np.ndarray, "frames objects 3"],
    on_floor: np.ndarray,
    found: Sequence[Impact],
    fps: float,
) -> tuple[Node, ...]:
    """Nodes in the first frame in the air after each impact, or several in a row.

    Args:
      batch: whose path it is; of the first candidate.
      poses: the path.
      velocity: in every frame [m/s].
      spin: in every frame, world frame [rad/s].
      on_floor: whether each object touches the floor in each frame.
      found: impacts along the path.
      fps: frames a second.
    """
    nodes: list[Node] = []
    for target in range(poses.shape[1]):
        size = float(batch.size[0, target].max())
        for row in _rows([i for i in found if i.target == target]):
            frame = row[-1].frame + 1
            while frame < len(poses) and on_floor[frame, target]:
                frame += 1
            if frame > len(poses) - LEAST_LEFT:
                continue
            if nodes and nodes[-1].target == target and nodes[-1].frame == frame:
                row = [*nodes.pop().struck, *row]
            state = np.concatenate([poses[frame, target], velocity[frame, target], spin[frame, target]])
            nodes.append(Node(target, frame, state, _sigma(row, frame, size, fps), tuple(row)))
    return tuple(nodes)


def with_struck(found: list[Impact], nodes: Sequence[Node]) -> list[Impact]:
    """Impacts along a path; those beside its nodes, where it jumps, as they were when these were made."""
    near = {(n.target, n.frame + k) for n in nodes for k in (-1, 0, 1)}
    struck = [i for n in nodes for i in n.struck if (i.target, i.frame) in near]
    return [i for i in found if (i.target, i.frame) not in near] + struck


def _rows(found: list[Impact]) -> list[list[Impact]]:
    """Impacts in frames that follow each other."""
    rows: list[list[Impact]] = []
    for one in sorted(found, key=lambda i: i.frame):
        if rows and one.frame - rows[-1][-1].frame <= 1:
            rows[-1].append(one)
        else:
            rows.append([one])
    return rows


def _sigma(row: list[Impact], frame: int, size: float, fps: float) -> Float[np.ndarray, "12"]:
    changes = np.linalg.norm([[i.blow, i.twist / size] for i in row], axis=0)
    lag = max(frame - row[0].frame, 1) / fps
    speeds = PART * changes
    places = speeds * lag + BLUR / fps * changes
    return LEAST + np.repeat([*places, *speeds], 3)
