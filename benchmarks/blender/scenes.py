"""Random scenes in CLEVRER's manner: spheres, cubes and cylinders of rubber or metal that slide, roll and collide."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.clips import bounce, rotation
from benchmarks.clips.camera import Camera

Entry = dict[str, Any]
UP = np.array([0.0, 0.0, 1.0])
COLOURS = {
    "gray": (0.25, 0.25, 0.25),
    "red": (0.60, 0.03, 0.03),
    "blue": (0.03, 0.09, 0.60),
    "green": (0.03, 0.30, 0.05),
    "brown": (0.22, 0.09, 0.03),
    "purple": (0.30, 0.05, 0.45),
    "cyan": (0.04, 0.50, 0.50),
    "yellow": (0.65, 0.50, 0.03),
}
MATERIALS = ("rubber", "metal")
AIR = {"linear_damping": 0.04, "angular_damping": 0.1}
"""Blender's own defaults; the scene format has nothing like them."""


@dataclass(frozen=True)
class Look:
    """What an object looks like, in CLEVRER's words."""

    colour: str
    material: str


@dataclass(frozen=True)
class Drawn:
    """A scene to simulate and draw.

    Attributes:
      entries: the scene's entries (FORMATS, section 1); friction is Bullet's, damping has its restitution.
      looks: of each object. restitution: of each object. light: of the stage, for Blender.
    """

    entries: list[Entry]
    looks: list[Look]
    restitution: list[float]
    light: dict[str, Any]

    @property
    def objects(self) -> list[Entry]:
        """Entries of the objects."""
        return [entry for entry in self.entries if "name" in entry]

    def bodies(self) -> list[dict[str, Any]]:
        """The objects in the words of `worker.py`."""
        return [
            _body(entry, look, restitution)
            for entry, look, restitution in zip(self.objects, self.looks, self.restitution, strict=True)
        ]


def _body(entry: Entry, look: Look, restitution: float) -> dict[str, Any]:
    state, metal = entry["state"], look.material == "metal"
    turn = rotation.matrix(np.array(state["orientation"]))
    return {
        "type": entry["type"],
        "size": half_extents(entry),
        "position": state["position"],
        "quaternion": state["orientation"],
        "velocity": state["linear_velocity"],
        "spin": (turn @ np.array(state["angular_velocity"])).tolist(),
        "mass": entry["physics"]["mass"],
        "friction": entry["physics"]["friction"][0],
        "restitution": restitution,
        "colour": COLOURS[look.colour],
        "metal": metal,
        "speckle": 0.03 if metal else 0.08,
        **AIR,
    }


def half_extents(entry: Entry) -> list[float]:
    """Half sizes of the box that holds a body in its own frame, m."""
    if entry["type"] == "box":
        return [float(s) for s in entry["size"]]
    height = entry["height"] / 2 if entry["type"] == "cylinder" else entry["radius"]
    return [float(entry["radius"]), float(entry["radius"]), float(height)]


def draw_scene(rng: np.random.Generator, objects: int, size: tuple[int, int] = (480, 320)) -> Drawn:
    """A scene of 1 to 4 objects; the first moves, others move or are aimed at. It may still fail the filters.

    Args:
      rng: source of all randomness. objects: how many. size: picture (width, height), pixels.
    """
    pitch = float(rng.uniform(44, 56))
    camera = Camera((0.0, -2.0, float(rng.uniform(2.2, 3.2))), pitch, float(rng.uniform(36, 46)), *size)
    entries: list[Entry] = []
    looks = looks_of(rng, objects)
    restitution = [float(rng.uniform(0.2, 0.7)) for _ in looks]
    shapes = [shape_of(rng) for _ in looks]
    places = places_of(rng, camera, shapes)
    for i, (shape, place) in enumerate(zip(shapes, places, strict=True)):
        moves = i == 0 or rng.random() < 0.5
        aim = aimed(rng, camera, places, i)
        entries.append(entry_of(rng, shape, place, aim if moves else None, looks[i], restitution[i], i))
    entries.append({"type": "camera", "fovy": camera.fovy, "orientation": pitch, "position": list(camera.position)})
    entries.append({"type": "gravity", "gravity": [0.0, 0.0, -9.81]})
    return Drawn(entries, looks, restitution, light_of(rng))


def looks_of(rng: np.random.Generator, count: int) -> list[Look]:
    """No two alike, as in CLEVRER."""
    every = [Look(colour, material) for colour in COLOURS for material in MATERIALS]
    return [every[i] for i in rng.choice(len(every), count, replace=False)]


def shape_of(rng: np.random.Generator) -> Entry:
    """A random sphere, cube or cylinder, 0.16 to 0.24 m in half size."""
    kind, half = str(rng.choice(["sphere", "box", "cylinder"])), float(rng.uniform(0.16, 0.24))
    if kind == "sphere":
        return {"type": kind, "radius": half}
    if kind == "box":
        return {"type": kind, "size": [0.85 * half] * 3}
    return {"type": kind, "radius": 0.9 * half, "height": 1.8 * half}


def places_of(rng: np.random.Generator, camera: Camera, shapes: list[Entry]) -> list[Float[np.ndarray, "2"]]:
    """Spots on the floor, in view and apart."""
    found: list[np.ndarray] = []
    for _ in range(500):
        if len(found) == len(shapes):
            break
        image = np.array([rng.uniform(0.12, 0.88) * camera.width, rng.uniform(0.18, 0.88) * camera.height])
        spot = camera.on_plane(image, 0.2)[:2]
        gaps = [
            np.linalg.norm(spot - other)
            - rotation.bounding_radius(shapes[len(found)])
            - rotation.bounding_radius(shapes[i])
            for i, other in enumerate(found)
        ]
        if min(gaps, default=1.0) > 0.08:
            found.append(spot)
    while len(found) < len(shapes):  # a crowd: the filters will refuse it
        found.append(found[-1] if found else np.zeros(2))
    return found


def aimed(rng: np.random.Generator, camera: Camera, places: list[np.ndarray], index: int) -> Float[np.ndarray, "2"]:
    """Another object, more or less, or some spot in view."""
    others = [place for i, place in enumerate(places) if i != index]
    if others and rng.random() < 0.8:
        near = min(others, key=lambda place: float(np.linalg.norm(place - places[index])))
        target = near if rng.random() < 0.6 else others[int(rng.integers(len(others)))]
        return target + rng.normal(0, 0.06, 2)
    image = np.array([rng.uniform(0.2, 0.8) * camera.width, rng.uniform(0.25, 0.85) * camera.height])
    return camera.on_plane(image, 0.2)[:2]


def entry_of(
    rng: np.random.Generator,
    shape: Entry,
    place: Float[np.ndarray, "2"],
    aim: Float[np.ndarray, "2"] | None,
    look: Look,
    restitution: float,
    index: int,
) -> Entry:
    """The entry of a body on the floor at `place`, on its way to `aim` (m; None: at rest)."""
    kind, yaw = shape["type"], rotation.about(UP, rng.uniform(-np.pi, np.pi))
    way = np.zeros(3) if aim is None else np.array([*(aim - place), 0.0])
    distance = float(np.linalg.norm(way))
    speed = 0.0 if distance < 1e-6 else float(np.clip(distance / rng.uniform(0.3, 0.7), 0.9, 3.2))
    velocity = way / max(distance, 1e-9) * speed
    spin = UP * rng.normal(0, 1.5) if speed else np.zeros(3)
    quaternion = yaw
    rolls = kind == "sphere" or (kind == "cylinder" and speed > 0 and rng.random() < 0.25)
    if rolls and speed:
        axis = np.cross(UP, velocity) / speed
        spin = axis * speed / shape["radius"] * rng.uniform(0.5, 1.0)
        if kind == "cylinder":
            lying = rotation.about(np.array([0.0, 1.0, 0.0]), np.pi / 2)
            quaternion = rotation.product(rotation.about(UP, np.arctan2(axis[1], axis[0])), lying)
    height = rotation.half_height(shape, quaternion)
    sliding = rng.uniform(0.3, 0.8) if rolls else rng.uniform(0.1, 0.45)
    density = 1.6 if look.material == "metal" else 1.0
    return {
        "type": kind,
        "name": f"{kind}_{index}",
        **{key: value for key, value in shape.items() if key != "type"},
        "state": {
            "position": [float(place[0]), float(place[1]), float(height)],
            "orientation": quaternion.tolist(),
            "linear_velocity": velocity.tolist(),
            "angular_velocity": (rotation.matrix(quaternion).T @ spin).tolist(),
        },
        "physics": {
            "friction": [float(sliding), 0.0],
            "mass": float(density * (max(half_extents(shape)) / 0.2) ** 3),
            "damping": bounce.damping(restitution),
        },
    }


def light_of(rng: np.random.Generator) -> dict[str, Any]:
    """Sun, sky and floor of a random stage."""
    turn, grey = rng.uniform(-np.pi, np.pi), float(rng.uniform(0.3, 0.5))
    return {
        "way": [float(0.6 * np.cos(turn)), float(0.6 * np.sin(turn)), -1.0],
        "strength": float(rng.uniform(2.0, 3.0)),
        "sky": [float(v) for v in rng.uniform(0.35, 0.8, 3)],
        "floor": [grey, grey, grey],
        "grain": 0.06,
    }
