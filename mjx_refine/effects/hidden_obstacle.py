"""Something unseen that an object hits."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
from jaxtyping import Float

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch, uniform_inertia
from mjx_refine.effects.closing import GAIN, GLANCE, glance, swing
from mjx_refine.effects.kind import (
    EffectKind,
    EffectParameter,
    FitView,
    Loads,
    Motion,
    Start,
    of_target,
)
from mjx_refine.scene import Shape

STIFFNESS = 20000.0
"""Of the wall's contact at most [1/s^2]."""

ROUND = 48
"""Points of a circle seen from above."""


class HiddenObstacle(EffectKind):
    """An upright wall that the target alone feels.

    Its face is n . p = distance with the outward normal n = (cos angle, sin angle, 0). The contact is a damped spring
    at the body's foremost point that pushes and never pulls, and rubs with the body's own sliding friction.
    """

    name = "hidden_obstacle"
    sentence = "{target} hits something that is not in the scene"
    experiment = "Send {target} along the same path again, and along a parallel one: an obstacle stays where it is."
    targeted = True
    physical = True
    strikes = True
    parameters = (
        EffectParameter("angle", "degree", 15.0, -3600.0, 3600.0, 0.0, None),
        EffectParameter("distance", "m", 0.05, -1e4, 1e4, 0.0, None),
        EffectParameter("restitution", "1", 0.3, 0.02, 0.98, 0.5, 0.5),
    )

    def loads(self, motion: Motion, target: int, values: np.ndarray) -> Loads | None:
        normal, arm, depth = _met(motion, target, values)
        velocity = motion.velocity[:, target] + rotations.cross(motion.spin[:, target], arm)
        approach = -(velocity * normal).sum(-1)
        # A body that starts behind the wall is not thrown out of it.
        met = (depth + 0.5 * np.maximum(approach, 0.0) * motion.step > 0) & (depth < 0.3)
        if not met.any():
            return None
        damping = damping_of(values[:, 2], motion.step)
        pressed = pressed_by(np.minimum(depth, 0.1), approach, damping, motion.step)
        size = np.where(met, pressed, 0.0) / _mobility(motion, target, arm, normal)
        slip = velocity + approach[:, None] * normal
        grip = (
            motion.batch.friction[:, target, :1] * slip / np.maximum(np.linalg.norm(slip, axis=-1, keepdims=True), 0.05)
        )
        force = size[:, None] * (normal - grip)
        return of_target(motion.batch, target, force), of_target(motion.batch, target, rotations.cross(arm, force))

    def idle(self, motion: Motion, target: int, values: np.ndarray) -> float:
        normal, _, depth = _met(motion, target, values)
        if (depth >= 0).any():
            return 0.0
        velocity = motion.velocity[:, target]
        # The floor may turn a fall into a way to the wall, and so may a body that comes along.
        closing = np.maximum(-(velocity * normal).sum(-1), 0.0) + np.abs(velocity[:, 2]) + swing(motion, target)
        alone = glance(-depth, closing)
        return alone if alone < 2 * motion.step else glance(-depth, closing + _pushed(motion, target))

    def starts(self, view: FitView, target: int) -> list[Start]:
        found = []
        for t in range(2, view.frames - 1, 2):
            v = view.velocity[t, target, :2]
            if float(np.linalg.norm(v)) < 0.15:
                continue
            heading = float(np.degrees(np.arctan2(-v[1], -v[0])))
            found += [self.facing(view, target, t, heading + turn) for turn in (-50.0, 0.0, 50.0)]
        return [dataclasses.replace(start, places=len(found)) for start in found]

    def window(self, view: FitView, target: int, values: np.ndarray) -> tuple[int, int] | None:
        near = np.nonzero(gaps(view.batch, view.poses, target, values) < 0.02)[0]
        if len(near) == 0:
            return None
        first = int(near[0])
        later = near[near > first + 3]
        return max(first - 1, 0), int(near[-1] if len(later) == 0 or len(near) > 6 else near[near <= first + 3][-1])

    def to_pivot(self, values: np.ndarray, pivot: np.ndarray) -> np.ndarray:
        return values - _beyond(values, pivot)

    def from_pivot(self, coordinates: np.ndarray, pivot: np.ndarray) -> np.ndarray:
        # A wall that is turned about the world's origin is elsewhere; turned about what touches it, it is hit at that moment.
        return coordinates + _beyond(coordinates, pivot)

    def facing(self, view: FitView, target: int, frame: int, angle: float) -> Start:
        """The wall with the outward normal at ``angle`` [degree] that the target touches in ``frame``."""
        turned = np.radians(angle)
        normal = np.array([[np.cos(turned), np.sin(turned), 0.0]])
        pose = view.poses[frame : frame + 1, None, target]
        batch = _alone(view.batch, target)
        still = Motion(0.0, 1.0, pose[..., :3], pose[..., 3:], pose[..., :3], pose[..., :3], batch)
        reach = float((foremost(still, 0, -normal) * normal).sum())
        distance = float(normal[0, :2] @ pose[0, 0, :2]) + reach
        outline = _from_above(view.batch.shapes[target], view.batch.size[0, target], pose[0, 0])
        return Start(np.array([angle, distance, 0.5]), width=np.array([25.0, 0.08, 0.3]), pivot=outline)


def _beyond(values: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """How far along the normal an outline begins, as what is added to the distance, (batch, 3)."""
    angle = np.deg2rad(values[:, 0])
    begins = (np.stack([np.cos(angle), np.sin(angle)], -1) @ pivot.T).min(-1)
    return np.stack([0 * angle, begins, 0 * angle], -1)


def _from_above(
    shape: Shape, size: Float[np.ndarray, "3"], pose: Float[np.ndarray, "7"]
) -> Float[np.ndarray, "points 2"]:
    """Points whose hull, seen from above, is a body's outline [m]."""
    around = np.linspace(0.0, 2 * np.pi, ROUND, endpoint=False)
    rim = np.stack([np.cos(around), np.sin(around), 0 * around], -1)
    if shape == "sphere":
        return pose[:2] + size[0] * rim[:, :2]
    if shape == "box":
        points = size * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    else:
        ends = np.concatenate([rim + np.array([0.0, 0.0, end]) for end in (-1.0, 1.0)])
        points = ends * size[[0, 0, 1]]
    return (pose[:3] + rotations.rotate(np.repeat(pose[None, 3:], len(points), 0), points))[:, :2]


def gaps(
    batch: SceneBatch, poses: Float[np.ndarray, "frames objects 7"], target: int, values: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "frames"]:
    """How far the target is from the wall in every frame of the first candidate's motion [m]; less than nothing in the wall."""
    place, turn = poses[:, target, None, :3], poses[:, target, None, 3:]
    motion = Motion(0.0, 1.0, place, turn, 0 * place, 0 * place, _alone(batch, target))
    return -_met_at(motion, 0, np.repeat(values[None], len(poses), 0))[2]


def _met(motion: Motion, target: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The wall's normals, the way from the target's centre to its foremost point, and how deep that is in the wall [m]."""
    # Asked twice at every instant: for how long nothing happens, and for what does.
    key = ("hidden_obstacle", target, values.tobytes())
    if key not in motion.known:
        motion.known[key] = _met_at(motion, target, values)
    return motion.known[key]


def _met_at(motion: Motion, target: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    angle = np.deg2rad(values[:, 0])
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
    arm = foremost(motion, target, -normal)
    return normal, arm, values[:, 1] - ((motion.position[:, target] + arm) * normal).sum(-1)


def _pushed(motion: Motion, target: int) -> np.ndarray:
    """Speed of the fastest other body that can meet the target within ``GLANCE``, (batch,) [m/s]."""
    others = [n for n in range(motion.position.shape[1]) if n != target]
    if not others:
        return np.zeros(len(motion.position))
    speed = np.linalg.norm(motion.velocity, axis=-1)
    reach = np.linalg.norm(motion.batch.size, axis=-1) + (speed + GLANCE * GAIN / 2) * GLANCE
    apart = np.linalg.norm(motion.position[:, others] - motion.position[:, target, None], axis=-1)
    near = apart < reach[:, others] + reach[:, target, None]
    swept = np.stack([swing(motion, n) for n in others], -1)
    return np.where(near, speed[:, others] + swept, 0.0).max(-1)


def stiffness_of(step: float) -> float:
    """The wall's stiffness [1/s^2]; less at a coarse time step, at which it would gain energy."""
    return min(STIFFNESS, 0.35 / step**2)


def damping_of(restitution: Float[np.ndarray, "*batch"] | float, step: float) -> Float[np.ndarray, "*batch"]:
    """Damping of the wall's contact [1/s] that returns the part ``restitution`` of a speed, in steps of ``step`` [s]."""
    damping, returned = _returned(step)
    return np.interp(-np.asarray(restitution), -returned, damping)


@functools.cache
def _returned(step: float) -> tuple[np.ndarray, np.ndarray]:
    """Dampings [1/s] and the part of a speed that each returns."""
    damping = 2 * np.sqrt(stiffness_of(step)) * np.concatenate([np.linspace(0.0, 1.0, 64), np.geomspace(1.02, 6.0, 32)])
    returned = -_speed_after(np.zeros_like(damping), np.ones_like(damping), damping, np.inf, step)
    return damping, np.minimum.accumulate(returned)


def pressed_by(
    depth: Float[np.ndarray, "batch"],
    approach: Float[np.ndarray, "batch"],
    damping: Float[np.ndarray, "batch"],
    step: float,
) -> Float[np.ndarray, "batch"]:
    """Acceleration that the wall gives to the point that touches it, in the mean over a step [m/s^2].

    A damped spring that pushes and never pulls, followed through the step as if nothing else acted: from the moment when the wall
    is reached, which may be within the step, to the one when it would pull. So what it does is smooth in where it stands.

    Args:
      depth: of the point in the wall at the step's start, less than nothing before it [m].
      approach: speed into the wall [m/s].
      damping: of the contact [1/s].
      step: length [s].
    """
    # MuJoCo's Euler steps move bodies by the velocity of a step's end: what is told at its start is that of half a step before.
    depth = depth - 0.5 * approach * step
    late = np.where(depth < 0, -depth / np.maximum(approach, 1e-9), 0.0)
    after = _speed_after(np.maximum(depth, 0.0), approach, damping, np.maximum(step - late, 0.0), step)
    return (approach - after) / step


def _speed_after(depth: np.ndarray, speed: np.ndarray, damping: np.ndarray, time, step: float) -> np.ndarray:
    """Speed into the wall after some time in it, or where it stops to push, if that is sooner [m/s]."""
    stiffness, decay = stiffness_of(step), 0.5 * damping
    beat = np.sqrt(np.maximum(np.abs(stiffness - decay**2), 1e-6 * stiffness))
    swings = decay**2 < stiffness
    force, pull = stiffness * depth + damping * speed, (stiffness * depth + decay * speed) / beat
    # The force is A cos + B sin where the spring swings, and A cosh + B sinh where it is damped too much for that.
    changing = stiffness * (speed + decay * depth) / beat - damping * pull
    with np.errstate(divide="ignore", invalid="ignore"):
        crept = np.where(changing < -force, np.arctanh(np.clip(-force / changing, 0.0, 1.0 - 1e-12)), np.inf)
    ends = np.where(swings, np.arctan2(changing, np.maximum(force, 0.0)) + 0.5 * np.pi, crept) / beat
    told = np.minimum(time, np.where(force > 0, ends, np.where((force == 0) & (speed > 0), np.pi / beat, 0.0)))
    angle = np.minimum(beat * told, 50.0)
    even, odd = np.where(swings, np.cos(angle), np.cosh(angle)), np.where(swings, np.sin(angle), np.sinh(angle))
    return np.exp(-decay * told) * (speed * even - pull * odd)


def _mobility(motion: Motion, target: int, arm: np.ndarray, normal: np.ndarray) -> Float[np.ndarray, "batch"]:
    """Acceleration along the normal of the point that touches for every newton along it [1/kg]."""
    if "inertia" not in motion.lasting:
        motion.lasting["inertia"] = uniform_inertia(motion.batch)
    turn = np.einsum("bij,bi->bj", motion.axes[:, target], rotations.cross(arm, normal))
    return 1.0 / motion.batch.mass[:, target] + (turn**2 / motion.lasting["inertia"][:, target]).sum(-1)


def _alone(batch: SceneBatch, target: int) -> SceneBatch:
    return dataclasses.replace(batch, shapes=batch.shapes[target : target + 1], size=batch.size[:, target : target + 1])


def foremost(motion: Motion, target: int, direction: np.ndarray) -> np.ndarray:
    """From the target's centre to its point that lies farthest in ``direction`` (batch, 3) [m]."""
    shape, size = motion.batch.shapes[target], motion.batch.size[:, target]
    if shape == "sphere":
        return size[:, :1] * direction
    matrix = motion.axes[:, target]
    local = np.einsum("bij,bi->bj", matrix, direction)
    if shape == "box":
        # Flat faces touch at their middle: the sign turns to zero where the face is square to the wall.
        point = size * np.clip(local / 0.1, -1.0, 1.0)
    else:
        across = np.linalg.norm(local[:, :2], axis=-1, keepdims=True)
        rim = size[:, :1] * local[:, :2] / np.maximum(across, 0.1)
        point = np.concatenate([rim, size[:, 1:2] * np.clip(local[:, 2:] / 0.1, -1.0, 1.0)], -1)
    return np.einsum("bij,bj->bi", matrix, point)
