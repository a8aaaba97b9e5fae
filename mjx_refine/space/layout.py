"""Which parameters a scene has, and how wide the prior of each is.

Bounds reach several prior widths to each side of the start, clipped to what is physical. The widths are those of a
vision-language model's errors, not of nature: they scale the search and say what a clip that shows nothing leaves alone.
"""

from __future__ import annotations

import math

import numpy as np

from mjx_refine import rotations
from mjx_refine.scene import Body, Scene
from mjx_refine.space.parameter import Parameter

_AXES = ("x", "y", "z")
REACH = 6.0
"""Bounds lie this many prior widths from the start."""

LENGTHS = (1e-4, 1e3)
"""Sizes that a scene file may hold [m]; with the next two the bounds keep to what can be read again."""

FARTHEST = 1e4
"""Largest coordinate [m] and speed [m/s] of a scene file."""

STRONGEST = 1e3
"""Largest component of gravity of a scene file [m/s^2]."""

STEEPEST = math.radians(80.0)
"""Elevation that the axis of a lying cylinder may reach [rad]."""


def linear(name, unit, field, index, start, width, low=-math.inf, high=math.inf, reach=0.0) -> Parameter:
    """A parameter on a linear scale; its bounds lie at least ``reach`` from the start."""
    reach = max(reach, REACH * width)
    low, high = max(low, start - reach), min(high, start + reach)
    return Parameter(name, unit, field, index, start, low, high, width)


def logarithmic(name, unit, field, index, start, width, low=0.0, high=math.inf, offset=0.0) -> Parameter:
    """A parameter on a logarithmic scale, ``width`` in natural logarithms."""
    factor = math.exp(REACH * width)
    # A scene may hold the smallest of floats, a fraction of which would be zero, whose logarithm does not exist.
    low = max(low, (start + offset) / factor - offset, math.ulp(0.0) - offset)
    high = min(high, (start + offset) * factor - offset)
    return Parameter(name, unit, field, index, start, min(low, start), max(high, start), width, offset)


def lowest_extent(shape: str, size: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """How far a body reaches below its centre [m]; ``size`` is MuJoCo's (…, 3), ``quaternion`` (…, 4)."""
    if shape == "sphere":
        return size[..., 0]
    down = rotations.matrix(quaternion)[..., 2, :]
    if shape == "box":
        return (np.abs(down) * size).sum(-1)
    # Not sqrt(1 - z^2), which turns a rounding error of an upright axis into 1e-8.
    across = np.hypot(down[..., 0], down[..., 1])
    return np.abs(down[..., 2]) * size[..., 1] + across * size[..., 0]


def _axis(body: Body) -> np.ndarray:
    return rotations.matrix(np.array(body.orientation))[:, 2]


def is_upright(body: Body) -> bool:
    """Whether a cylinder's axis is nearer to the vertical than to the floor."""
    return abs(_axis(body)[2]) > math.sqrt(0.5)


def body_parameters(i: int, body: Body, gap: float, lone: bool) -> list[Parameter]:
    """Everything continuous of object ``i``; ``gap`` is its clearance above the floor [m]."""
    name = body.name
    resting = gap < 0.03 and abs(body.linear_velocity[2]) < 0.5
    return [
        *_size_parameters(i, body),
        *_pose_parameters(i, body, gap, resting),
        *_velocity_parameters(i, body, resting),
        logarithmic(f"{name}.friction.sliding", "1", "friction", (i, 0), body.friction[0], 0.6, 0.0, 4.0, 0.05),
        logarithmic(f"{name}.friction.rolling", "m", "friction", (i, 1), body.friction[1], 0.8, 0.0, 1.0, 0.004),
        logarithmic(f"{name}.damping", "1/s", "resistance", (i, 0), -body.damping, 1.0, 0.0, 250.0, 1.0),
        *([] if lone else [logarithmic(f"{name}.mass", "kg", "mass", (i, 0), body.mass, 0.5, 0.0, 1e6)]),
    ]


def _size_parameters(i: int, body: Body) -> list[Parameter]:
    if body.shape == "sphere":
        return [logarithmic(f"{body.name}.radius", "m", "size", (i, 0), body.size[0], 0.2, *LENGTHS)]
    if body.shape == "cylinder":
        halves = (LENGTHS[0] / 2, LENGTHS[1] / 2)
        return [
            logarithmic(f"{body.name}.radius", "m", "size", (i, 0), body.size[0], 0.2, *LENGTHS),
            # The array holds half the height, as MuJoCo's geom_size does.
            logarithmic(f"{body.name}.half_height", "m", "size", (i, 1), body.size[1] / 2, 0.2, *halves),
        ]
    return [
        logarithmic(f"{body.name}.size.{a}", "m", "size", (i, k), body.size[k], 0.2, *LENGTHS)
        for k, a in enumerate(_AXES)
    ]


def _pose_parameters(i: int, body: Body, gap: float, resting: bool) -> list[Parameter]:
    name = body.name
    tilt = 0.06 if resting else 0.3
    result = [
        linear(f"{name}.position.x", "m", "position", (i, 0), body.position[0], 0.3, -FARTHEST, FARTHEST),
        linear(f"{name}.position.y", "m", "position", (i, 1), body.position[1], 0.3, -FARTHEST, FARTHEST),
        # Height is measured from the floor to the lowest point: no candidate starts in the floor.
        linear(
            f"{name}.clearance", "m", "clearance", (i, 0), gap, 0.02 if resting else 0.05 + 0.25 * gap, 0.0, reach=1.0
        ),
    ]
    if body.shape == "box" or (body.shape == "cylinder" and not is_upright(body)):
        result.append(linear(f"{name}.yaw", "rad", "yaw", (i, 0), 0.0, 0.35, -math.pi, math.pi))
    if body.shape == "box" or (body.shape == "cylinder" and is_upright(body)):
        most = _largest_tilt(body)
        result.append(linear(f"{name}.tilt.x", "rad", "tilt", (i, 0), 0.0, tilt, -most, most, reach=1.2))
        result.append(linear(f"{name}.tilt.y", "rad", "tilt", (i, 1), 0.0, tilt, -most, most, reach=1.2))
    elif body.shape == "cylinder":
        # About the horizontal direction across the axis; turning about the axis itself cannot be seen. It stays off the
        # vertical, where yaw is such a turn.
        up = math.asin(min(max(_axis(body)[2], -1.0), 1.0))
        bounds = (up - STEEPEST, up + STEEPEST)
        result.append(linear(f"{name}.tilt", "rad", "lean", (i, 0), 0.0, tilt, *bounds, reach=1.2))
    return result


def _largest_tilt(body: Body) -> float:
    """Bound of each of two tilts that keeps them independent [rad].

    A turn by v about a horizontal axis moves a body's vertical axis in two independent directions for |v| < pi; the axis
    of a cylinder that slants by a in the first place, for |v| < pi - 2 a.
    """
    slant = math.acos(min(abs(float(_axis(body)[2])), 1.0)) if body.shape == "cylinder" else 0.0
    return (math.pi - 2 * slant - 0.2) / math.sqrt(2)


def _velocity_parameters(i: int, body: Body, resting: bool) -> list[Parameter]:
    spin = rotations.rotate(np.array(body.orientation), np.array(body.angular_velocity))
    round_body = body.shape != "box"
    result = []
    for k, axis in enumerate(_AXES):
        v = body.linear_velocity[k]
        width = (0.1 if resting else 0.5) + 0.3 * abs(v) if k == 2 else 0.4 + 0.3 * abs(v)
        bounds = (-FARTHEST, FARTHEST)
        result.append(
            linear(f"{body.name}.velocity.{axis}", "m/s", "linear_velocity", (i, k), v, width, *bounds, reach=3.0)
        )
    for k, axis in enumerate(_AXES):
        width = (0.4 if resting and not round_body and k < 2 else 2.0) + 0.4 * abs(spin[k])
        result.append(linear(f"{body.name}.spin.{axis}", "rad/s", "spin", (i, k), float(spin[k]), width))
    return result


def world_parameters(scene: Scene) -> list[Parameter]:
    """Camera height, pitch and field of view, and the strength of gravity."""
    camera = scene.camera
    pitch, fovy = math.radians(camera.orientation), math.radians(camera.fovy)
    result = []
    if camera.position[2] > 0:
        result.append(
            logarithmic("camera.height", "m", "camera_position", (-1, 2), camera.position[2], 0.1, 0.0, FARTHEST)
        )
    result.append(linear("camera.pitch", "rad", "camera_pitch", (-1, 0), pitch, 0.09, -2 * math.pi, 2 * math.pi))
    result.append(logarithmic("camera.fovy", "rad", "camera_fovy", (-1, 0), fovy, 0.12, 0.01, 3.0))
    strength = float(np.linalg.norm(scene.gravity))
    if strength > 0:
        most = strength * ((1 - 1e-12) * STRONGEST / max(map(abs, scene.gravity)))
        result.append(logarithmic("gravity", "m/s^2", "gravity", (-1, 0), strength, 0.2, 0.0, most))
    return result
