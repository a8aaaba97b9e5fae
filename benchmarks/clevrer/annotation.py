"""CLEVRER's annotation of a video: what its objects are, where they are in every frame, when they meet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.clevrer import plain
from mjx_refine.errors import InputError

SHAPES = ("sphere", "cylinder", "cube")
MATERIALS = ("rubber", "metal")
MOST_OBJECTS = 64


@dataclass(frozen=True)
class Thing:
    """An object's number in the file and what tells it from the others; no two of a video are alike."""

    number: int
    shape: str
    color: str
    material: str

    @property
    def look(self) -> tuple[str, str, str]:
        """(color, material, shape), as proposals name it."""
        return self.color, self.material, self.shape


@dataclass(frozen=True)
class Meeting:
    """A collision: the objects' numbers, its frame, its place (world)."""

    objects: tuple[int, int]
    frame: int
    location: tuple[float, float, float] | None


@dataclass(frozen=True)
class Annotation:
    """An annotation.

    Attributes:
      things: the objects, in the file's order.
      location, velocity: in the data set's world and units, (frames, objects, 3). orientation: angles as the file has
        them (radians), (frames, objects, 3). angular_velocity: ditto, (frames, objects, 3).
      inside: whether the camera sees the object's place, (frames, objects).
      collisions: by frame. source: of messages.
    """

    things: tuple[Thing, ...]
    location: Float[np.ndarray, "frames objects 3"]
    orientation: Float[np.ndarray, "frames objects 3"]
    velocity: Float[np.ndarray, "frames objects 3"]
    angular_velocity: Float[np.ndarray, "frames objects 3"]
    inside: Bool[np.ndarray, "frames objects"]
    collisions: tuple[Meeting, ...]
    source: str

    @property
    def length(self) -> int:
        """Frames."""
        return len(self.location)


def load_annotation(path: Path) -> Annotation:
    """Reads `annotation_NNNNN.json`.

    Raises:
      InputError: it cannot be read, or something in it is missing or wrong.
    """
    data = plain.load_json(path, "a CLEVRER annotation")
    things = read_things(plain.entries(data, "object_property", str(path)), f"{path}: object_property")
    order = {thing.number: i for i, thing in enumerate(things)}
    frames = plain.entries(data, "motion_trajectory", str(path))
    if not frames:
        raise InputError(f"{path}: motion_trajectory is empty; expected an entry a frame; get the file again")
    shape = (len(frames), len(things), 3)
    arrays = {key: np.full(shape, np.nan) for key in ("location", "orientation", "velocity", "angular_velocity")}
    inside, seen = np.zeros(shape[:2], bool), np.zeros(shape[:2], bool)
    for t, frame in enumerate(frames):
        where = f"{path}: motion_trajectory[{t}]"
        if plain.whole(frame, "frame_id", where) != t:
            raise InputError(f"{where}.frame_id = {frame['frame_id']}; expected {t}, frames in order; correct it")
        for k, state in enumerate(plain.entries(frame, "objects", where)):
            place = f"{where}.objects[{k}]"
            i = order.get(plain.whole(state, "object_id", place), -1)
            if i < 0 or seen[t, i]:
                wrong = "is told twice" if i >= 0 else "is none of object_property's"
                raise InputError(f"{place}.object_id = {state['object_id']} {wrong}; expected each object once")
            seen[t, i] = True
            for key, values in arrays.items():
                values[t, i] = plain.vector(state, key, place)
            inside[t, i] = plain.entry(state, "inside_camera_view", place) is True
    if not seen.all():
        t, i = (int(n) for n in np.argwhere(~seen)[0])
        raise InputError(f"{path}: motion_trajectory[{t}] lacks object {things[i].number}; expected all in each frame")
    meetings = _meetings(plain.entries(data, "collision", str(path)), f"{path}: collision", set(order), len(frames))
    return Annotation(things, **arrays, inside=inside, collisions=meetings, source=str(path))


def read_things(listed: list[Any], where: str, key: str = "object_id") -> tuple[Thing, ...]:
    """The objects of a list of `{key, shape, color, material}`.

    Raises:
      InputError: there is none, two have one number or look alike, or a property is wrong.
    """
    things = tuple(
        Thing(
            plain.whole(item, key, f"{where}[{i}]"),
            plain.word(item, "shape", f"{where}[{i}]", SHAPES),
            plain.word(item, "color", f"{where}[{i}]"),
            plain.word(item, "material", f"{where}[{i}]", MATERIALS),
        )
        for i, item in enumerate(listed)
    )
    if not 0 < len(things) <= MOST_OBJECTS:
        raise InputError(f"{where}: {len(things)} objects; expected 1 to {MOST_OBJECTS}; get the file again")
    for name, values in (("number", [t.number for t in things]), ("look", [t.look for t in things])):
        if len(set(values)) < len(values):
            raise InputError(f"{where}: two objects have one {name}; expected all to differ; correct it")
    return things


def _meetings(listed: list[Any], where: str, known: set[int], frames: int) -> tuple[Meeting, ...]:
    found = []
    for i, item in enumerate(listed):
        pair = plain.entries(item, "object_ids", f"{where}[{i}]")
        # Ids are compared as they stand, so that a list or text among them is no crash but unknown.
        if len(pair) != 2 or not all(isinstance(n, int) and n in known for n in pair):
            raise InputError(
                f"{where}[{i}].object_ids = {str(pair)[:60]}; expected two of object_property's; correct it"
            )
        place = plain.vector(item, "location", f"{where}[{i}]") if "location" in item else None
        frame = plain.whole(item, "frame_id", f"{where}[{i}]", 0, frames - 1)
        found.append(Meeting((pair[0], pair[1]), frame, None if place is None else (place[0], place[1], place[2])))
    return tuple(sorted(found, key=lambda meeting: meeting.frame))
