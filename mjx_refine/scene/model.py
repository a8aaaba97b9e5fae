"""The scene: what the YAML configuration says, validated and immutable."""

from __future__ import annotations

import dataclasses
from typing import Literal

Shape = Literal["sphere", "box", "cylinder"]
SHAPES: tuple[Shape, ...] = ("sphere", "box", "cylinder")

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclasses.dataclass(frozen=True)
class Body:
    """One rigid object of uniform density, at the first frame.

    Attributes:
      shape: the primitive.
      name: unique in the scene.
      size: [m] sphere (radius,); box half extents (x, y, z); cylinder (radius, FULL height along the body's z axis).
      position: centre, world frame, z up [m].
      orientation: unit quaternion w x y z, body to world.
      linear_velocity: world frame [m/s].
      angular_velocity: BODY frame, as MuJoCo's free joint has it [rad/s].
      friction: (sliding [1], rolling [m]).
      mass: [kg].
      damping: contact damping, the second number of MuJoCo's ``solref`` in the direct format, <= 0 [1/s].
      stiffness: minus the first number of that ``solref``, > 0 [1/s^2].
    """

    shape: Shape
    name: str
    size: tuple[float, ...]
    position: Vector3
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    linear_velocity: Vector3 = (0.0, 0.0, 0.0)
    angular_velocity: Vector3 = (0.0, 0.0, 0.0)
    friction: tuple[float, float] = (0.5, 0.01)
    mass: float = 1.0
    damping: float = -4.0
    stiffness: float = 5000.0


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera whose principal point is the middle of the image.

    Attributes:
      position: [m], world frame.
      orientation: rotation about the world's x axis [degree]; 0 looks straight down, 90 looks along +y.
      fovy: vertical field of view [degree].
    """

    position: Vector3
    orientation: float
    fovy: float = 45.0


@dataclasses.dataclass(frozen=True)
class Effect:
    """Something that the base model lacks: a name, perhaps an object's name, and parameters."""

    effect: str
    target: str | None = None
    parameters: tuple[tuple[str, float | str | tuple[float, ...]], ...] = ()


@dataclasses.dataclass(frozen=True)
class Scene:
    """Objects, one camera, gravity [m/s^2] and, optionally, effects."""

    objects: tuple[Body, ...]
    camera: Camera
    gravity: Vector3 = (0.0, 0.0, -9.81)
    effects: tuple[Effect, ...] = ()

    @property
    def shapes(self) -> tuple[Shape, ...]:
        return tuple(body.shape for body in self.objects)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(body.name for body in self.objects)
