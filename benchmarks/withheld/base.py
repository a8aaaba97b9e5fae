"""The numbers of a scene without effects that a diagnosis may refit, each with the width of its prior."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.clips import rotation
from benchmarks.clips.bullet import Entry, bodies
from benchmarks.withheld.stage import resting
from benchmarks.withheld.start import UP

SIZE, PLACE, TURN, VELOCITY, SPIN = 0.03, 0.03, np.radians(2), 0.06, 0.1
FRICTION, DAMPING, GRAVITY = 0.2, 0.4, 0.03
PITCH, FOVY, HEIGHT = 0.7, 1.0, 0.03
MASS, STILL, UNTURNED = 0.1, 0.08, 0.4
"""Widths. The first three rows are those of `start.rough`; the last is for what `rough` leaves alone and a diagnosis does
not: masses of objects that meet (in logarithms), speeds [m/s] and spins [rad/s] of objects at rest."""

Move = Callable[[Entry, float], None]


@dataclass(frozen=True)
class Number:
    """One number that may move.

    Fields:
      name: as it is told. owner: index of the object, -1 the whole world, -2 the camera.
      move: changes the owner's entry by so many widths, in place.
    """

    name: str
    owner: int
    move: Move


WORLD, CAMERA = -1, -2


class Base:
    """A scene without effects around the truth.

    Fields:
      numbers: what may move. entries: the true scene.
    """

    def __init__(self, entries: list[Entry], meeting: tuple[int, ...] = ()):
        """`meeting`: objects that meet others, whose masses can be told."""
        self.entries = entries
        objects = bodies(entries)
        self.resting = [resting(entry) for entry in objects]
        numbers = [number for i, entry in enumerate(objects) for number in _of_body(i, entry)]
        numbers += [Number(f"{objects[i]['name']}.mass", i, _scaled(("physics", "mass"), MASS)) for i in meeting]
        numbers += [
            Number("gravity", WORLD, _gravity),
            Number("camera.pitch", CAMERA, lambda e, x: e.update(orientation=e["orientation"] + PITCH * x)),
            Number("camera.fovy", CAMERA, lambda e, x: e.update(fovy=e["fovy"] + FOVY * x)),
            Number("camera.height", CAMERA, _higher),
        ]
        self.numbers = tuple(numbers)

    def at(self, shifts: Float[np.ndarray, "numbers"]) -> list[Entry]:
        """The scene with its numbers moved by so many widths; what rests on the floor goes on resting on it."""
        scene = copy.deepcopy(self.entries)
        objects = bodies(scene)
        owners = {WORLD: _entry(scene, "gravity"), CAMERA: _entry(scene, "camera"), **dict(enumerate(objects))}
        for number, shift in zip(self.numbers, shifts, strict=True):
            if shift:
                number.move(owners[number.owner], float(shift))
        for entry, rests in zip(objects, self.resting, strict=True):
            state = entry["state"]
            height = rotation.half_height(entry, np.asarray(state["orientation"], float))
            state["position"][2] = height if rests else max(state["position"][2], height)
        return scene


def _entry(scene: list[Entry], kind: str) -> Entry:
    return next(e for e in scene if e["type"] == kind)


def _of_body(i: int, entry: Entry) -> list[Number]:
    name, state, rests = entry["name"], entry["state"], resting(entry)
    moves: list[tuple[str, Move]] = [(k, _scaled((k,), SIZE)) for k in ("radius", "height") if k in entry]
    moves += [(f"size.{a}", _scaled(("size", k), SIZE)) for k, a in enumerate("xyz") if "size" in entry]
    if entry["type"] != "sphere":  # turned, a ball looks and rolls as before
        width = TURN if rests else TURN / np.sqrt(3)
        moves += [(f"turn.{a}", _turned(np.eye(3)["xyz".index(a)], width)) for a in ("z" if rests else "xyz")]
    level = "xy" if rests else "xyz"
    moves += [(f"position.{a}", _added("position", np.eye(3)[k] * PLACE)) for k, a in enumerate(level)]
    speed = float(np.linalg.norm(state["linear_velocity"]))
    width = VELOCITY * speed or STILL
    moves += [(f"velocity.{a}", _added("linear_velocity", np.eye(3)[k] * width)) for k, a in enumerate(level)]
    moves += [(f"spin.{a}", _added("angular_velocity", way)) for a, way in _spins(entry, rests)]
    moves += [(f"friction.{k}", _scaled(("physics", "friction", k), FRICTION)) for k in (0, 1)]
    moves.append(("damping", _scaled(("physics", "damping"), DAMPING)))
    return [Number(f"{name}.{what}", i, move) for what, move in moves]


def _spins(entry: Entry, rests: bool) -> list[tuple[str, np.ndarray]]:
    """Names and steps of one width of what may turn faster or slower, in the body's frame."""
    spin = np.asarray(entry["state"]["angular_velocity"], float)
    width = SPIN * float(np.linalg.norm(spin))
    if not rests or (width and entry["type"] == "sphere"):
        return list(zip("xyz", np.eye(3) * (width or UNTURNED), strict=True))
    if width:  # lying on the floor, only about what it turns about already: no new tilt
        return [(a, axis * width) for a, axis, v in zip("xyz", np.eye(3), spin, strict=True) if abs(v) > 1e-9]
    turn = rotation.matrix(np.asarray(entry["state"]["orientation"], float))
    return [("up", turn.T @ UP * UNTURNED)]


def _scaled(path: tuple[Any, ...], width: float) -> Move:
    def move(entry: Entry, x: float) -> None:
        *way, last = path
        for key in way:
            entry = entry[key]
        entry[last] *= float(np.exp(width * x))

    return move


def _added(key: str, step: Float[np.ndarray, "3"]) -> Move:
    def move(entry: Entry, x: float) -> None:
        entry["state"][key] = (np.asarray(entry["state"][key], float) + step * x).tolist()

    return move


def _turned(axis: Float[np.ndarray, "3"], width: float) -> Move:
    def move(entry: Entry, x: float) -> None:
        quaternion = np.asarray(entry["state"]["orientation"], float)
        entry["state"]["orientation"] = rotation.product(rotation.about(axis, width * x), quaternion).tolist()

    return move


def _gravity(entry: Entry, x: float) -> None:
    entry["gravity"] = (np.asarray(entry["gravity"], float) * np.exp(GRAVITY * x)).tolist()


def _higher(entry: Entry, x: float) -> None:
    entry["position"][2] += HEIGHT * x
