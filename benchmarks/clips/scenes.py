"""Random scenes of a wanted kind of motion, as entries of the scene format."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.clips import bounce, rotation
from benchmarks.clips.camera import Camera

Entry = dict[str, Any]
KINDS = ("flight", "slide", "roll", "bounce", "topple", "collision")
UP = np.array([0.0, 0.0, 1.0])


def draw_scene(rng: np.random.Generator, kind: str, objects: int, size: tuple[int, int] = (480, 320)) -> list[Entry]:
    """One random scene; it may still fail the filters of `make_clip`.

    Args:
      rng: source of all randomness.
      kind: one of KINDS; what the first object does (of a collision: the first hits the second).
      objects: 1 to 4; a collision needs two.
      size: picture (width, height), pixels.

    Raises:
      ValueError: unknown kind, or a number of objects that the kind does not allow.
    """
    if kind not in KINDS:
        raise ValueError(f"kind = {kind!r}; expected one of {', '.join(KINDS)}")
    if not (2 if kind == "collision" else 1) <= objects <= 4:
        raise ValueError(f"objects = {objects} for kind {kind}; expected 1 to 4, and 2 to 4 for a collision")
    camera = Camera(
        (0.0, -2.0, float(rng.uniform(2, 4.5))), float(rng.uniform(30, 55)), float(rng.uniform(35, 60)), *size
    )
    gravity = 9.81 if rng.random() < 0.6 else float(rng.uniform(5, 12))
    entries: list[Entry] = []
    if kind == "collision":
        entries += _collision(rng, camera, gravity)
    while len(entries) < objects:
        motion = kind if not entries else str(rng.choice(["rest", "slide", "roll", "bounce"], p=[0.2, 0.3, 0.3, 0.2]))
        for _ in range(30):
            entry = _DRAW[motion](rng, camera, gravity)
            if all(_apart(entry, other) for other in entries):
                break
        entries.append(entry)
    named: list[Entry] = []
    for index, entry in enumerate(entries):
        named.append({"type": entry["type"], "name": f"{entry['type']}_{index}", **entry})
    return [
        *named,
        {"type": "camera", "fovy": camera.fovy, "orientation": camera.pitch, "position": list(camera.position)},
        {"type": "gravity", "gravity": [0.0, 0.0, -gravity]},
    ]


def _apart(a: Entry, b: Entry) -> bool:
    gap = np.linalg.norm(np.subtract(a["state"]["position"], b["state"]["position"]))
    return bool(gap > 0.9 * (rotation.bounding_radius(a) + rotation.bounding_radius(b)))


def _spot(rng: np.random.Generator, camera: Camera, z: float) -> np.ndarray:
    """A point at height z that shows in the middle part of the picture and not too far off."""
    for _ in range(100):
        image = np.array([rng.uniform(0.15, 0.85) * camera.width, rng.uniform(0.25, 0.85) * camera.height])
        if camera.rays(image)[2] < -0.2:
            point = camera.on_plane(image, z)
            if np.linalg.norm(point - np.array(camera.position)) < 7:
                return point
    return camera.on_plane(np.array([camera.width / 2, camera.height * 0.7]), z)


def _heading(rng: np.random.Generator, camera: Camera, start: np.ndarray, low: float, high: float) -> np.ndarray:
    """A horizontal velocity towards another point in view, its speed between low and high, m/s."""
    way = (_spot(rng, camera, float(start[2])) - start) * rng.uniform(0.8, 1.3)
    way[2] = 0
    length = float(np.linalg.norm(way)) + 1e-9
    return way / length * np.clip(length, low, high)


def _shape(rng: np.random.Generator, camera: Camera, types: tuple[str, ...]) -> Entry:
    """A body of one of the types, big enough to be seen well from this camera."""
    distance = camera.position[2] / np.cos(np.radians(camera.pitch))
    seen = float(np.clip(rng.uniform(15, 40) * distance / camera.focal * camera.height / 320, 0.12, 0.42))
    kind = str(rng.choice(types))
    if kind == "sphere":
        return {"type": kind, "radius": seen}
    if kind == "box":
        return {"type": kind, "size": np.clip(seen * rng.uniform(0.7, 1.3, 3), 0.12, 0.45).tolist()}
    return {
        "type": kind,
        "radius": float(np.clip(seen * rng.uniform(0.7, 1.1), 0.12, 0.45)),
        "height": float(seen * rng.uniform(1.2, 2.4)),
    }


def _finish(
    rng: np.random.Generator,
    shape: Entry,
    position: np.ndarray,
    quaternion: np.ndarray,
    velocity: np.ndarray,
    spin: np.ndarray,
    friction: tuple[float, float],
    rebound: tuple[float, float],
) -> Entry:
    """The entry; `spin` is in the world frame, rad/s, and is written in the body's."""
    body_spin = rotation.matrix(quaternion).T @ spin
    return {
        **shape,
        "state": {
            "position": np.asarray(position, float).tolist(),
            "orientation": np.asarray(quaternion, float).tolist(),
            "linear_velocity": np.asarray(velocity, float).tolist(),
            "angular_velocity": body_spin.tolist(),
        },
        "physics": {
            "friction": [float(rng.uniform(*friction)), float(rng.uniform(0.0005, 0.008))],
            "mass": float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))),
            "damping": bounce.damping(float(rng.uniform(*rebound))),
        },
    }


def _standing(rng: np.random.Generator, camera: Camera, shape: Entry, quaternion: np.ndarray) -> np.ndarray:
    return _spot(rng, camera, rotation.half_height(shape, quaternion))


def _yaw(rng: np.random.Generator) -> np.ndarray:
    return rotation.about(UP, rng.uniform(-np.pi, np.pi))


def _rest(rng: np.random.Generator, camera: Camera, gravity: float) -> Entry:
    shape, q = _shape(rng, camera, ("sphere", "box", "cylinder")), _yaw(rng)
    position = _standing(rng, camera, shape, q)
    return _finish(rng, shape, position, q, np.zeros(3), np.zeros(3), (0.2, 0.9), (0.0, 0.5))


def _slide(rng: np.random.Generator, camera: Camera, gravity: float) -> Entry:
    shape, q = _shape(rng, camera, ("box", "box", "cylinder")), _yaw(rng)
    if shape["type"] == "box":  # low, so that it slides and does not tip
        shape["size"][2] = min(shape["size"][2], max(0.12, 0.9 * min(shape["size"][:2])))
    else:
        shape["height"] = min(shape["height"], 1.5 * shape["radius"])
    position = _standing(rng, camera, shape, q)
    velocity = _heading(rng, camera, position, 1.2, 4.0)
    return _finish(rng, shape, position, q, velocity, UP * rng.normal(0, 1.5), (0.1, 0.5), (0.0, 0.4))


def _roll(rng: np.random.Generator, camera: Camera, gravity: float) -> Entry:
    shape = _shape(rng, camera, ("sphere", "cylinder"))
    probe = _standing(rng, camera, shape, np.array([1.0, 0, 0, 0]))
    velocity = _heading(rng, camera, probe, 0.8, 3.0)
    axis = np.cross(UP, velocity) / np.linalg.norm(velocity)
    yaw = np.arctan2(axis[1], axis[0])
    lying = rotation.product(rotation.about(UP, yaw), rotation.about(np.array([0.0, 1, 0]), np.pi / 2))
    q = lying if shape["type"] == "cylinder" else rotation.random(rng)
    position = np.array([probe[0], probe[1], shape["radius"]])
    spin = axis * np.linalg.norm(velocity) / shape["radius"] * rng.uniform(0.6, 1.0)
    return _finish(rng, shape, position, q, velocity, spin, (0.3, 0.9), (0.0, 0.5))


def _flight(rng: np.random.Generator, camera: Camera, gravity: float) -> Entry:
    shape, q = _shape(rng, camera, ("sphere", "box", "cylinder")), rotation.random(rng)
    ceiling = 0.55 * camera.position[2]
    height = rotation.half_height(shape, q) + rng.uniform(0.15, 0.7)
    rise = min(rng.uniform(1.0, 4.0), np.sqrt(2 * gravity * max(ceiling - height, 0.1)))
    position = _spot(rng, camera, height)
    velocity = _heading(rng, camera, position, 0.6, 2.5) + UP * rise
    return _finish(rng, shape, position, q, velocity, rng.normal(0, 2.0, 3), (0.2, 0.9), (0.0, 0.6))


def _bounce(rng: np.random.Generator, camera: Camera, gravity: float) -> Entry:
    shape, q = _shape(rng, camera, ("sphere", "sphere", "box", "cylinder")), rotation.random(rng)
    height = rotation.half_height(shape, q) + rng.uniform(0.3, 0.25 * camera.position[2])
    position = _spot(rng, camera, height)
    velocity = _heading(rng, camera, position, 0.3, 1.8) - UP * rng.uniform(0, 1.5)
    return _finish(rng, shape, position, q, velocity, rng.normal(0, 1.0, 3), (0.2, 0.9), (0.5, 0.8))


def _topple(rng: np.random.Generator, camera: Camera, gravity: float) -> Entry:
    shape = _shape(rng, camera, ("box", "cylinder"))
    width = float(rng.uniform(0.12, 0.2))
    half = float(np.clip(width * rng.uniform(1.9, 2.6), 0.25, 0.45))
    if shape["type"] == "box":
        shape["size"] = [width, float(np.clip(width * rng.uniform(0.9, 1.5), 0.12, 0.4)), half]
    else:
        shape = {"type": "cylinder", "radius": width, "height": 2 * half}
    upright = _yaw(rng)
    axis = rotation.matrix(upright)[:, 1]  # it falls over the edge along its own y, towards its x
    lean = np.arctan(width / half) * rng.uniform(0.5, 1.0)
    q = rotation.product(rotation.about(axis, lean), upright)
    position = _standing(rng, camera, shape, q)
    spin = axis * rng.uniform(1.5, 3.5)
    pivot = rotation.matrix(q) @ np.array([width, 0.0, -half])
    velocity = np.cross(spin, -pivot) + rotation.matrix(upright)[:, 0] * rng.uniform(0, 1.0)
    return _finish(rng, shape, position, q, velocity, spin, (0.5, 0.9), (0.0, 0.3))


def _collision(rng: np.random.Generator, camera: Camera, gravity: float) -> list[Entry]:
    """Something that slides or rolls into something that rests."""
    target = _rest(rng, camera, gravity)
    mover = _DRAW[str(rng.choice(["slide", "roll"]))](rng, camera, gravity)
    for _ in range(30):
        if _apart(mover, target):
            break
        target = _rest(rng, camera, gravity)
    start, aim = np.array(mover["state"]["position"]), np.array(target["state"]["position"])
    way = aim + rng.normal(0, 0.3, 3) * rotation.bounding_radius(target) - start
    way[2] = 0
    distance = float(np.linalg.norm(way))
    speed = np.clip(distance / rng.uniform(0.25, 0.5), 1.5, 4.0)
    turn = np.arctan2(way[1], way[0]) - np.arctan2(*mover["state"]["linear_velocity"][1::-1])
    before = float(np.linalg.norm(mover["state"]["linear_velocity"]))
    # The mover turns as a whole about the vertical; its spin, in its own frame, turns with it.
    q = rotation.product(rotation.about(UP, turn), np.array(mover["state"]["orientation"]))
    mover["state"]["orientation"] = q.tolist()
    mover["state"]["linear_velocity"] = (way / distance * speed).tolist()
    if "radius" in mover and mover["state"]["position"][2] == mover["radius"]:
        mover["state"]["angular_velocity"] = (np.array(mover["state"]["angular_velocity"]) * speed / before).tolist()
    return [mover, target]


_DRAW: dict[str, Callable[[np.random.Generator, Camera, float], Entry]] = {
    "rest": _rest,
    "slide": _slide,
    "roll": _roll,
    "flight": _flight,
    "bounce": _bounce,
    "topple": _topple,
}
