"""How far contacts may be off: no two engines, and no real floor, give the same impulse.

Each impact of the fitted base model may err by a part of its change of velocity and spin. What such an error does to the
measurements is a column c of a linear model; errors of standard deviation one along K columns C add C C' to the
covariance of the residuals, which (I + C C')^(-1/2) whitens. So a residual that an impact's error explains costs little,
and one that it cannot explain costs what it did.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch, concatenate
from mjx_refine.effects import acting
from mjx_refine.sim.backends import Simulator
from mjx_refine.sim.model import SUBSTEPS
from mjx_refine.space.layout import lowest_extent

PART = 0.08
"""Standard deviation of an impulse's error, as a part of the change of velocity (and, times a radius, of spin)."""

LEAST = 0.25
"""Changes of velocity within one frame that are taken for an impact [m/s]."""

MOST = 8
"""Impacts an object that are looked at, strongest first."""

SPUN = 3.0
"""Change of spin, times the size, that friction with the floor makes at most, as a multiple of what it changes velocity by: 2.5
for a ball, 2 for a cylinder that rolls."""

STEADY = 0.1
"""How far from gravity's the change of velocity that holds a body up on the floor is in a frame [m/s]."""

FELT = 0.2
"""Error in noise widths below which nobody would see it."""

PHASES, SHORTEST = 3, 6
"""Into how many parts a time on the floor is cut, and how many frames it must last."""

SLIDING, ROLLING = (0.35, 0.1), (1.0, 0.05)
"""How large the error of the change of velocity in each is against that of an impact, and the least part of the speed that
is taken for a change: every engine has a law of its own for rolling friction."""

PARTED = 1e-4
"""Distance between the paths with an effect and without from which on it acts [m]."""

REMEMBERED = 16
"""Decompositions of columns that are kept at a time."""


@dataclasses.dataclass(frozen=True)
class Impact:
    """One impact of the fitted model.

    Attributes:
      target: the object.
      frame: the first frame after it.
      change: of velocity [m/s].
      turn: of spin, times the body's size [m/s].
    """

    target: int
    frame: int
    change: float
    turn: float

    @property
    def blow(self) -> float:
        """What its error of velocity is a part of [m/s]: what turns a body may as well have pushed it."""
        return self.change + 0.5 * self.turn

    @property
    def twist(self) -> float:
        """What its error of spin, times the body's size, is a part of [m/s]: what pushed a body may as well have turned it."""
        return self.turn + 0.3 * self.change


Contacts = tuple[list[Impact], list[Impact]]
"""Impacts, and times on the floor."""


@dataclasses.dataclass(frozen=True)
class Slack:
    """What whitens residuals that share the impacts' errors: r - U d U' r.

    Attributes:
      basis: U, orthonormal.
      shrink: d, in [0, 1).
    """

    basis: Float[np.ndarray, "residuals slack"]
    shrink: Float[np.ndarray, "slack"]

    def __call__(self, residuals: Float[np.ndarray, "batch residuals"]) -> Float[np.ndarray, "batch residuals"]:
        return residuals - ((residuals @ self.basis) * self.shrink) @ self.basis.T

    @property
    def price(self) -> float:
        """Half the logarithm of det(I + C C')."""
        return -float(np.log1p(-self.shrink).sum())


def slack_of(columns: Float[np.ndarray, "residuals columns"]) -> Slack:
    """From the columns C, one standard deviation each."""
    basis, size, _ = np.linalg.svd(columns, full_matrices=False)
    felt = size > FELT
    return Slack(np.ascontiguousarray(basis[:, felt]), 1.0 - 1.0 / np.sqrt(1.0 + size[felt] ** 2))


@dataclasses.dataclass
class Slacks:
    """What was made of a clip's columns, by frames that are kept and by what a hypothesis adds.

    Attributes:
      made: by keys; with the columns that these are of, so that no other array comes to have their address.
    """

    made: dict[tuple[bytes, int, int], tuple[Slack, np.ndarray, np.ndarray | None]] = dataclasses.field(
        default_factory=dict
    )

    def of(
        self,
        columns: Float[np.ndarray, "residuals columns"],
        added: np.ndarray | None,
        keep: np.ndarray | None,
        kept: Callable[[np.ndarray], np.ndarray],
    ) -> Slack:
        """From the columns of contacts and what a hypothesis adds, where ``keep`` (None: everywhere) says by ``kept``."""
        key = (b"" if keep is None else keep.tobytes(), id(columns), id(added))
        if key not in self.made:
            if len(self.made) >= REMEMBERED:
                self.made.pop(next(iter(self.made)))
            both = columns if added is None else np.concatenate([columns, added], 1)
            self.made[key] = (slack_of(both if keep is None else both * kept(keep)[:, None]), columns, added)
        return self.made[key][0]


def impacts(batch: SceneBatch, poses: Float[np.ndarray, "frames objects 7"], fps: float) -> list[Impact]:
    """Impacts of a fitted rollout: where velocity or spin jump by more than gravity, and friction with the floor, make them."""
    velocity = np.diff(poses[..., :3], axis=0) * fps
    spin = spins(poses, fps)
    jump = np.diff(velocity, axis=0) - batch.gravity[0] / fps
    twist = np.diff(spin, axis=0)
    fall, on_floor = float(np.linalg.norm(batch.gravity[0])) / fps, touching(batch, poses)
    stays = on_floor[:-2] & on_floor[1:-1] & on_floor[2:]
    found = []
    for n in range(poses.shape[1]):
        size = float(batch.size[0, n].max())
        change, turn = np.linalg.norm(jump[:, n], axis=-1), np.linalg.norm(twist[:, n], axis=-1) * size
        rubbed = _beyond_friction(jump[:, n], turn, fall, float(batch.friction[0, n, 0]))
        strength = np.where(stays[:, n], rubbed, change + 0.5 * turn)
        frames = [t for t in np.argsort(-strength) if strength[t] > LEAST][:MOST]
        found += [Impact(n, int(t) + 1, float(change[t]), float(turn[t])) for t in frames]
    return found


def _beyond_friction(
    jump: Float[np.ndarray, "jumps 3"], turn: Float[np.ndarray, "jumps"], fall: float, friction: float
) -> Float[np.ndarray, "jumps"]:
    """How much stronger jumps are than what the floor does in every frame to a body that lies, slides or rolls on it [m/s].

    Args:
      jump: of velocity, without gravity's [m/s].
      turn: of spin, times the body's size [m/s].
      fall: change of velocity that gravity makes in a frame [m/s].
      friction: with the floor.
    """
    along, up = np.linalg.norm(jump[:, :2], axis=-1), np.abs(jump[:, 2])
    rubs = friction * fall
    beyond = np.hypot(np.maximum(along - rubs, 0.0), np.maximum(np.abs(up - fall) - STEADY, 0.0))
    return beyond + 0.5 * np.maximum(turn - SPUN * rubs, 0.0)


def contacts(
    batch: SceneBatch,
    poses: Float[np.ndarray, "frames objects 7"],
    plain: Float[np.ndarray, "frames objects 7"] | None,
    fps: float,
) -> Contacts:
    """Impacts and times on the floor along a path; what effects themselves do is neither.

    Args:
      batch: whose path it is, with its effects.
      poses: the path.
      plain: the same without effects; None where there are none.
      fps: frames a second.
    """
    on_floor = touching(batch, poses)
    if plain is None:
        return impacts(batch, poses, fps), sustained(batch, poses, on_floor, fps)
    if not np.isfinite(plain).all():
        return impacts(batch, poses, fps), []
    return _not_own(impacts(batch, poses, fps), impacts(batch, plain, fps), poses, plain), sustained(
        batch, plain, on_floor, fps
    )


def _not_own(found: list[Impact], plain: list[Impact], poses: np.ndarray, without: np.ndarray) -> list[Impact]:
    """But for jumps that an effect itself makes where it first acts on an object: a push, something that is hit."""
    apart = np.linalg.norm(poses[..., :3] - without[..., :3], axis=-1) > PARTED
    first = [int(np.argmax(row)) if row.any() else -9 for row in apart.T]

    def own(one: Impact) -> bool:
        return abs(one.frame - first[one.target]) <= 1 and not any(
            one.target == other.target and abs(one.frame - other.frame) <= 1 for other in plain
        )

    return [one for one in found if not own(one)]


def touching(batch: SceneBatch, poses: Float[np.ndarray, "frames objects 7"]) -> Bool[np.ndarray, "frames objects"]:
    """Which bodies of the first candidate touch the floor, level or not."""
    turn = acting.floor_rotation(batch)
    if turn is not None:
        level = np.swapaxes(turn[0], -1, -2)
        turned = rotations.multiply(acting.quaternion_of(level), poses[..., 3:])
        poses = np.concatenate([poses[..., :3] @ level.T, turned], -1)
    lowest = [
        np.broadcast_to(lowest_extent(s, batch.size[0, n][None], poses[:, n, 3:]), len(poses))
        for n, s in enumerate(batch.shapes)
    ]
    return poses[..., 2] - np.stack(lowest, 1) < 0.01


def sustained(
    batch: SceneBatch, poses: Float[np.ndarray, "frames objects 7"], on_floor: np.ndarray, fps: float
) -> list[Impact]:
    """Times on the floor, in parts, each as an impact in its middle: engines slow bodies down in their own ways."""
    velocity, spin = np.diff(poses[..., :3], axis=0) * fps, spins(poses, fps)
    found = []
    for n in range(poses.shape[1]):
        rim = np.linalg.norm(spin[:, n], axis=-1) * float(batch.size[0, n, 0])
        rolls = batch.shapes[n] != "box" and bool(np.median(rim - 0.5 * np.linalg.norm(velocity[:, n], axis=-1)) > 0)
        share, least = ROLLING if rolls else SLIDING
        padded = np.concatenate([[False], on_floor[:, n], [False]])
        edges = np.nonzero(np.diff(padded.astype(int)))[0]
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            if end - first < SHORTEST:
                continue
            borders = np.linspace(first, min(end, len(velocity)) - 1, PHASES + 1).astype(int)
            for a, b in itertools.pairwise(borders):
                change = float(np.linalg.norm((velocity[b] - velocity[a])[n, :2]))
                speed = float(np.linalg.norm(velocity[a, n, :2]))
                if speed > 0.02:
                    found.append(Impact(n, int((a + b + 1) // 2), share * max(change, least * speed), 0.0))
    return found


def spins(poses: Float[np.ndarray, "frames objects 7"], fps: float) -> Float[np.ndarray, "intervals objects 3"]:
    """Angular velocities between frames, world frame [rad/s]."""
    turn = rotations.multiply(poses[1:, :, 3:], rotations.conjugate(poses[:-1, :, 3:]))
    turn = turn * np.where(turn[..., :1] < 0, -1.0, 1.0)
    half = np.arccos(np.clip(turn[..., :1], -1.0, 1.0))
    return 2 * half * turn[..., 1:] / np.maximum(np.sin(half), 1e-9) * fps


def kicked(
    simulator: Simulator,
    batch: SceneBatch,
    poses: Float[np.ndarray, "frames objects 7"],
    found: list[Impact],
    part: float,
) -> Float[np.ndarray, "rows frames objects 7"]:
    """Rollouts that go on from each impact with one standard deviation more of velocity or spin, which is ``part`` of its change.

    Rows are (impact, three velocities and three spins).
    """
    length = len(poses)
    velocity, spin = states(simulator, batch, poses)
    starts: dict[int, list[tuple[int, np.ndarray, np.ndarray]]] = {}
    rows = np.repeat(poses[None], 6 * len(found), 0)
    for k, impact in enumerate(found):
        size = float(batch.size[0, impact.target].max())
        width = part * impact.blow
        for axis in range(6):
            dv, dw = np.zeros(3), np.zeros(3)
            if axis < 3:
                dv[axis] = width
            else:
                dw[axis - 3] = part * impact.twist / size
            starts.setdefault(impact.frame, []).append((6 * k + axis, dv, dw))
    for frame, members in starts.items():
        here = _restarted(batch, poses[frame], velocity[frame], spin[frame], len(members))
        for row, (index, dv, dw) in enumerate(members):
            n = found[index // 6].target
            here.linear_velocity[row, n] += dv
            local = rotations.rotate(rotations.conjugate(here.quaternion[row, n]), dw)
            here.angular_velocity[row, n] += local
        plain = _restarted(batch, poses[frame], velocity[frame], spin[frame], 1)
        both = simulator.rollout(concatenate([here, plain]), length - frame)
        for row, (index, _, _) in enumerate(members):
            rows[index, frame:, :, :3] += both[row, :, :, :3] - both[-1, :, :, :3]
            rows[index, frame:, :, 3:] = _moved(poses[frame:, :, 3:], both[-1, :, :, 3:], both[row, :, :, 3:])
    return rows


def states(simulator: Simulator, batch: SceneBatch, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocities and spins in every frame, by backward differences corrected for gravity [m/s, rad/s]."""
    fps = simulator.fps
    step = 1.0 / (fps * SUBSTEPS)
    velocity = np.diff(poses[..., :3], axis=0) * fps
    spin = spins(poses, fps)
    free = np.abs(np.diff(velocity, axis=0, prepend=velocity[:1]) - batch.gravity[0] / fps).max(-1) < 0.05
    late = np.where(free[..., None], batch.gravity[0] * (0.5 / fps - 0.5 * step), 0.0)
    # After a frame, the next interval's mean velocity is nearer to the truth than the last one's where an impact was.
    velocity = np.concatenate([velocity - late, velocity[-1:]])
    return velocity, np.concatenate([spin, spin[-1:]])


def _restarted(batch: SceneBatch, pose: np.ndarray, velocity: np.ndarray, spin: np.ndarray, count: int) -> SceneBatch:
    # Frames are counted from here on.
    many = acting.untimed(dataclasses.replace(batch, restarts=())).map(lambda a: np.repeat(a[:1], count, 0))
    quaternion = np.repeat(pose[None, :, 3:], count, 0)
    return dataclasses.replace(
        many,
        position=np.repeat(pose[None, :, :3], count, 0),
        quaternion=quaternion,
        linear_velocity=np.repeat(velocity[None], count, 0),
        angular_velocity=rotations.rotate(rotations.conjugate(quaternion), np.repeat(spin[None], count, 0)),
    )


def _moved(base: np.ndarray, plain: np.ndarray, changed: np.ndarray) -> np.ndarray:
    """``base`` turned as ``changed`` is turned against ``plain``."""
    turn = rotations.multiply(changed, rotations.conjugate(plain))
    return rotations.multiply(turn, base)
