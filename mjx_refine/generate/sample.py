"""Random scenes: what stands, slides, rolls, flies and collides before the camera.

As in the data of Δynamics (CVPR 2026), the camera is at (0, -2, h) with varied pitch and field of view, gravity varies, and
what does not suit is filtered afterwards. Numbers are rounded to four decimals (orientations to six) here, before anything
is simulated: the scene that is simulated is the one that the text says.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from mjx_refine.generate.options import HELD_OUT, SIZE, SPLITS, GenerateOptions
from mjx_refine.scene import SHAPES, Body, Camera, Scene, Shape, scene_entries, scene_from_entries

_FARTHEST = 7.0
"""From the camera to the place at which an object is aimed [m]."""

_Vector = tuple[float, float, float]
_DOWN_X = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
"""Lays a body's z axis along the world's x."""


def shapes_of(options: GenerateOptions, index: int) -> tuple[Shape, ...]:
    """The object types of record ``index``, in the order of ``SHAPES``; chosen before the filters, which then do not favour
    few or large objects."""
    generator = np.random.default_rng((options.seed, SPLITS.index(options.split), index))
    if options.combinations is not None:
        return options.combinations[generator.integers(len(options.combinations))]
    fewest, most = options.counts
    count = int(generator.integers(fewest, most + 1))
    while True:
        shapes = tuple(SHAPES[k] for k in sorted(generator.integers(0, len(SHAPES), count)))
        if shapes not in HELD_OUT:
            return shapes


@dataclasses.dataclass(frozen=True)
class Proposal:
    """A scene that no filter has seen.

    Attributes:
      written: with the numbers that the text shows.
      scene: what reading that text gives: orientations are normalised.
    """

    written: Scene
    scene: Scene


def propose(options: GenerateOptions, index: int, attempt: int) -> Proposal:
    """Attempt ``attempt`` at record ``index``."""
    shapes = shapes_of(options, index)
    draw = _Draw(np.random.default_rng((options.seed, SPLITS.index(options.split), index, attempt + 1)))
    bodies: list[Body] = []
    for number, shape in enumerate(shapes):
        bodies.append(draw.body(shape, f"{shape}_{shapes[:number].count(shape)}", bodies))
    gravity = (0.0, 0.0, -round(draw.uniform(3.0, 12.0), 4))
    written = Scene(tuple(bodies), draw.camera, gravity)
    return Proposal(written, scene_from_entries(scene_entries(written)))


class _Draw:
    """One scene's camera, and its objects one after another."""

    def __init__(self, generator: np.random.Generator):
        self.generator = generator
        self.camera = Camera(
            position=(0.0, -2.0, round(self.uniform(1.5, 4.5), 4)),
            orientation=round(self.uniform(30.0, 65.0), 4),
            fovy=round(self.uniform(35.0, 60.0), 4),
        )

    def uniform(self, low: float, high: float) -> float:
        return low + (high - low) * self.generator.random()

    def log_uniform(self, low: float, high: float) -> float:
        return math.exp(self.uniform(math.log(low), math.log(high)))

    def normal(self, width: float) -> float:
        return width * float(self.generator.standard_normal())

    def chance(self, probability: float) -> bool:
        return self.generator.random() < probability

    def spot(self, height: float) -> tuple[float, float]:
        """(x, y) of a point at ``height`` that shows in the picture, not too far off [m]."""
        pitch = math.radians(self.camera.orientation)
        cosine, sine = math.cos(pitch), math.sin(pitch)
        half = math.tan(math.radians(self.camera.fovy) / 2)
        eye = self.camera.position
        right, ahead, reach = 0.0, 0.0, 0.0
        for _ in range(50):
            right = self.uniform(-0.85, 0.85) * half * SIZE[0] / SIZE[1]
            up = self.uniform(-0.8, 0.8) * half
            ahead, rise = cosine * up + sine, sine * up - cosine
            reach = (height - eye[2]) / min(rise, -1e-6)
            if 0 < reach * math.sqrt(right**2 + ahead**2 + rise**2) < _FARTHEST:
                break
        return right * reach, eye[1] + ahead * reach

    def body(self, shape: Shape, name: str, others: list[Body]) -> Body:
        """One object: on the floor or in the air, at rest or moving through a point that the camera sees."""
        size = self.size(shape)
        flies = self.chance(0.35)
        orientation = self.any_orientation() if flies else self.resting_orientation(shape)
        height = half_height(shape, size, orientation) + (self.uniform(0.05, 1.2) if flies else 0.0)
        # Upwards, so that nothing begins inside the floor.
        height = math.ceil(height * 1e4) / 1e4
        x, y = self.spot(height)
        # The first object always moves.
        across = (0.0, 0.0) if others and self.chance(0.3) else self.velocity(x, y, height, others)
        # Some come into view only later.
        late = self.uniform(0.0, 0.5) if self.chance(0.3) else 0.0
        rise = self.uniform(-1.0, 3.0) if flies and self.chance(0.7) else 0.0
        spin = self.spin(shape, size, orientation, across, flies)
        return Body(
            shape=shape,
            name=name,
            size=size,
            position=(round(x - late * across[0], 4), round(y - late * across[1], 4), height),
            orientation=orientation,
            linear_velocity=(round(across[0], 4), round(across[1], 4), round(rise, 4)),
            angular_velocity=spin,
            friction=(round(self.uniform(0.1, 1.2), 4), round(self.log_uniform(0.0005, 0.1), 4)),
            mass=round(self.log_uniform(0.2, 5.0), 4),
            damping=-round(self.log_uniform(4.0, 100.0), 4),
        )

    def size(self, shape: Shape) -> tuple[float, ...]:
        """As ``Body.size`` [m]."""
        if shape == "sphere":
            return (round(self.log_uniform(0.12, 0.5), 4),)
        if shape == "cylinder":
            return round(self.log_uniform(0.1, 0.4), 4), round(self.log_uniform(0.15, 1.2), 4)
        return tuple(round(self.log_uniform(0.1, 0.5), 4) for _ in range(3))

    def any_orientation(self) -> tuple[float, float, float, float]:
        w, x, y, z = (self.normal(1.0) for _ in range(4))
        length = math.sqrt(w * w + x * x + y * y + z * z) + 1e-12
        return round(w / length, 6), round(x / length, 6), round(y / length, 6), round(z / length, 6)

    def resting_orientation(self, shape: Shape) -> tuple[float, float, float, float]:
        """Flat on the floor: turned about the vertical; half of the cylinders lie; spheres turned at will."""
        if shape == "sphere":
            return self.any_orientation()
        turn = self.uniform(-math.pi, math.pi)
        w, z = math.cos(turn / 2), math.sin(turn / 2)
        if shape == "cylinder" and self.chance(0.5):
            a, _, c, _ = _DOWN_X
            return round(w * a, 6), round(-z * c, 6), round(w * c, 6), round(z * a, 6)
        return round(w, 6), 0.0, 0.0, round(z, 6)

    def velocity(self, x: float, y: float, height: float, others: list[Body]) -> tuple[float, float]:
        """Horizontal velocity [m/s] towards another object or another place in view."""
        if others and self.chance(0.6):
            goal = others[self.generator.integers(len(others))].position
        else:
            goal = (*self.spot(height), height)
        away = (goal[0] - x, goal[1] - y)
        speed = self.uniform(0.3, 4.0) / (math.hypot(*away) + 1e-9)
        return away[0] * speed, away[1] * speed

    def spin(self, shape: Shape, size, orientation, across: tuple[float, float], flies: bool) -> _Vector:
        """Body-frame angular velocity [rad/s]: tumbling in the air, on the floor rolling with or turning about the
        vertical."""
        if flies:
            x, y, z = (self.normal(3.0) for _ in range(3))
            return round(x, 4), round(y, 4), round(z, 4)
        world = (0.0, 0.0, self.normal(1.5) if any(across) else 0.0)
        axis = rotated(orientation, (0.0, 0.0, 1.0))
        rolls = shape == "sphere" or (shape == "cylinder" and abs(axis[2]) < 0.5)
        if rolls and self.chance(0.7):
            rate = self.uniform(0.6, 1.1) / size[0]
            world = (-across[1] * rate, across[0] * rate, 0.0)
            if shape == "cylinder":
                # It rolls about its own axis alone.
                part = world[0] * axis[0] + world[1] * axis[1]
                world = (part * axis[0], part * axis[1], 0.0)
        w, x, y, z = orientation
        turned = rotated((w, -x, -y, -z), world)
        # Adding zero takes the sign from zeros.
        return round(turned[0], 4) + 0.0, round(turned[1], 4) + 0.0, round(turned[2], 4) + 0.0


def rotated(quaternion: tuple[float, float, float, float], vector: _Vector) -> _Vector:
    """``vector`` rotated by a unit quaternion w x y z."""
    w, x, y, z = quaternion
    a, b, c = vector
    # v + 2 q x (q x v + w v), q the vector part.
    e, f, g = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return a + 2 * (y * g - z * f), b + 2 * (z * e - x * g), c + 2 * (x * f - y * e)


def half_height(shape: Shape, size: tuple[float, ...], quaternion: tuple[float, float, float, float]) -> float:
    """Of a body's centre above its lowest point [m]."""
    if shape == "sphere":
        return size[0]
    w, x, y, z = quaternion
    upwards = rotated((w, -x, -y, -z), (0.0, 0.0, 1.0))
    if shape == "box":
        return sum(abs(part) * half for part, half in zip(upwards, size, strict=True))
    along = min(abs(upwards[2]), 1.0)
    return along * size[1] / 2 + size[0] * math.sqrt(1.0 - along * along)
