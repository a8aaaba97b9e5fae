"""Scene configurations from YAML, checked entry by entry."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any, cast

from mjx_refine.errors import InputError
from mjx_refine.scene import fields
from mjx_refine.scene.model import SHAPES, Body, Camera, Effect, Quaternion, Scene
from mjx_refine.scene.plain import load_plain, read_text
from mjx_refine.scene.text import sample_texts

MAX_SAMPLES = 4096
MAX_SAMPLE_BYTES = 256 * 2**10
_STATE = ("position", "orientation", "linear_velocity", "angular_velocity")
_PHYSICS = ("friction", "mass", "damping", "stiffness")
_SIZE_KEYS = {"box": ("size",), "cylinder": ("radius", "height"), "sphere": ("radius",)}


@dataclasses.dataclass(frozen=True)
class Problem:
    """Why the sample with this index (from 0) could not be read."""

    index: int
    reason: str


@dataclasses.dataclass(frozen=True)
class Samples:
    """The samples of one file.

    Attributes:
      source: the file's name.
      scenes: those that could be read, in order.
      indices: for each of ``scenes``, its index in the file (from 0).
      problems: those that could not.
    """

    source: str
    scenes: tuple[Scene, ...]
    indices: tuple[int, ...]
    problems: tuple[Problem, ...] = ()

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, i: int) -> Scene:
        return self.scenes[i]


def load_scenes(path: str | os.PathLike) -> Samples:
    """Reads every sample of a scene file: a list, ``<answer>`` blocks, fenced blocks, or YAML documents.

    Raises:
      InputError: the file cannot be read, or no sample of it can.
    """
    return parse_scenes(read_text(path, "a scene file in YAML"), source=str(path))


def parse_scenes(text: str, source: str = "<text>") -> Samples:
    """Reads every sample of ``text``; ``source`` is its name in errors.

    Raises:
      InputError: no sample can be read.
    """
    texts = sample_texts(text)
    if not texts:
        raise InputError(
            f"{source}: no scene in it; expected a YAML list of entries (objects, camera, gravity); write one"
        )
    if len(texts) > MAX_SAMPLES:
        raise InputError(f"{source}: {len(texts)} samples; expected at most {MAX_SAMPLES}; remove some")
    scenes: list[Scene] = []
    indices: list[int] = []
    problems: list[Problem] = []
    for index, part in enumerate(texts):
        place = source if len(texts) == 1 else f"{source}: sample {index}"
        try:
            scenes.append(_parse_scene(part, place))
            indices.append(index)
        except InputError as error:
            problems.append(Problem(index, str(error)))
    if not scenes:
        more = f" (and {len(problems) - 1} more samples with errors)" if len(problems) > 1 else ""
        raise InputError(problems[0].reason + more)
    return Samples(source, tuple(scenes), tuple(indices), tuple(problems))


def load_scene(path: str | os.PathLike) -> Scene:
    """Reads a file that holds exactly one scene.

    Raises:
      InputError: it cannot be read, or it holds several samples.
    """
    samples = load_scenes(path)
    if len(samples) + len(samples.problems) != 1:
        raise InputError(
            f"{path}: {len(samples) + len(samples.problems)} samples; expected one scene; keep one of them"
        )
    return samples[0]


def _parse_scene(text: str, place: str) -> Scene:
    if len(text) > MAX_SAMPLE_BYTES:
        raise InputError(
            f"{place}: a sample of {len(text)} characters; expected at most {MAX_SAMPLE_BYTES}, a scene of 64 objects "
            "has 40000; remove or split it"
        )
    return scene_from_entries(load_plain(text, place, "the sample"), place)


def scene_from_entries(entries: object, place: str = "<scene>") -> Scene:
    """Makes a scene from the list that the YAML holds; ``place`` names its origin in errors.

    Raises:
      InputError: an entry is wrong; the message names entry and key.
    """
    if isinstance(entries, Mapping) or isinstance(entries, str | bytes) or not isinstance(entries, Sequence):
        raise InputError(
            f"{place}: got {fields.show(entries)}; expected a list of entries, each with a `type`; begin each with `- type: ...`"
        )
    objects: list[Body] = []
    cameras: list[Camera] = []
    gravities: list[tuple[float, float, float]] = []
    effects: list[Effect] = []
    for i, entry in enumerate(entries):
        where = f"{place}: entry {i}"
        if not isinstance(entry, Mapping):
            raise InputError(
                f"{where} = {fields.show(entry)}; expected a mapping with a `type`; write `- type: ...` and its keys below"
            )
        kind = fields.required(entry, "type", where)
        if isinstance(kind, str) and kind in SHAPES:
            objects.append(_body(entry, where, kind, len(objects)))
        elif kind == "camera":
            cameras.append(_camera(entry, where))
        elif kind == "gravity":
            entry = fields.mapping(entry, where, ("type", "gravity"))
            gravities.append(fields.vector(fields.required(entry, "gravity", where), f"{where}.gravity", 3, -1e3, 1e3))
        elif kind == "effect":
            effects.append(_effect(entry, where))
        else:
            expected = ", ".join((*SHAPES, "camera", "gravity", "effect"))
            raise InputError(f"{where}.type = {fields.show(kind)}; expected one of {expected}; correct the type")
    _check_counts(objects, cameras, gravities, effects, place)
    return Scene(tuple(objects), cameras[0], gravities[0] if gravities else Scene.gravity, tuple(effects))


def _check_counts(objects: list, cameras: list, gravities: list, effects: list[Effect], place: str) -> None:
    if not objects:
        raise InputError(f"{place}: no object; expected at least one sphere, box or cylinder; add one")
    if len(objects) > 64:
        raise InputError(f"{place}: {len(objects)} objects; expected at most 64; remove some")
    if len(cameras) != 1:
        raise InputError(
            f"{place}: {len(cameras)} entries of type camera; expected exactly one; "
            f"{'remove the others' if cameras else 'add one'}"
        )
    if len(gravities) > 1:
        raise InputError(f"{place}: {len(gravities)} entries of type gravity; expected at most one; remove the others")
    names = [body.name for body in objects]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"{place}: {names.count(name)} objects have the name {name!r}; names must differ; rename one"
            )
    for effect in effects:
        if effect.target is not None and effect.target not in names:
            raise InputError(
                f"{place}: effect {effect.effect}.target = {effect.target!r}; "
                f"expected an object's name: {fields.cut(', '.join(names))}; correct the target"
            )


def _body(entry: Mapping[str, Any], where: str, shape: Any, count: int) -> Body:
    name = fields.text(entry["name"], f"{where}.name") if entry.get("name") is not None else f"{shape}_{count}"
    where = f"{where} ({name})"
    entry = fields.mapping(entry, where, ("type", "name", *_SIZE_KEYS[shape], "state", "physics"))
    state = fields.mapping(fields.required(entry, "state", where), f"{where}.state", _STATE)
    physics = {} if entry.get("physics") is None else entry["physics"]
    physics = fields.mapping(physics, f"{where}.physics", _PHYSICS)

    def value(source: Mapping[str, Any], key: str, length: int, default: Any, *bounds: float, **options: bool) -> Any:
        place = f"{where}.{'state' if source is state else 'physics'}.{key}"
        if source.get(key) is None:
            return default
        if length:
            return fields.vector(source[key], place, length, *bounds, **options)
        return fields.number(source[key], place, *bounds, **options)

    fields.required(state, "position", f"{where}.state")
    return Body(
        shape=shape,
        name=name,
        size=_size(entry, where, shape),
        position=value(state, "position", 3, None, -1e4, 1e4),
        orientation=_quaternion(value(state, "orientation", 4, Body.orientation), f"{where}.state.orientation"),
        linear_velocity=value(state, "linear_velocity", 3, Body.linear_velocity, -1e4, 1e4),
        angular_velocity=value(state, "angular_velocity", 3, Body.angular_velocity, -1e4, 1e4),
        friction=value(physics, "friction", 2, Body.friction, 0.0, 10.0),
        mass=value(physics, "mass", 0, Body.mass, 0.0, 1e6, above=True),
        damping=value(physics, "damping", 0, Body.damping, -1e5, 0.0),
        stiffness=value(physics, "stiffness", 0, Body.stiffness, 0.0, 1e7, above=True),
    )


def _size(entry: Mapping[str, Any], where: str, shape: str) -> tuple[float, ...]:
    if shape == "box":
        return fields.vector(fields.required(entry, "size", where), f"{where}.size", 3, 1e-4, 1e3)
    keys = _SIZE_KEYS[shape]
    return tuple(fields.number(fields.required(entry, key, where), f"{where}.{key}", 1e-4, 1e3) for key in keys)


def _quaternion(value: tuple[float, ...], place: str) -> Quaternion:
    norm = math.sqrt(sum(v * v for v in value))
    if norm < 1e-6:
        raise InputError(
            f"{place} = {list(value)}; expected a quaternion w x y z that is not zero; [1, 0, 0, 0] is no rotation"
        )
    # Dividing an already normalised quaternion again would change its last digit.
    scale = 1.0 if abs(norm - 1.0) < 1e-12 else norm
    return cast(Quaternion, tuple(v / scale for v in value))


def _camera(entry: Mapping[str, Any], where: str) -> Camera:
    where = f"{where} (camera)"
    entry = fields.mapping(entry, where, ("type", "name", "fovy", "orientation", "position"))
    fovy = entry.get("fovy")
    return Camera(
        position=fields.vector(fields.required(entry, "position", where), f"{where}.position", 3, -1e4, 1e4),
        orientation=fields.number(fields.required(entry, "orientation", where), f"{where}.orientation", -360, 360),
        fovy=Camera.fovy if fovy is None else fields.number(fovy, f"{where}.fovy", 0.1, 175),
    )


def _effect(entry: Mapping[str, Any], where: str) -> Effect:
    where = f"{where} (effect)"
    entry = fields.mapping(entry, where, ("type", "effect", "target", "parameters"))
    target = entry.get("target")
    raw = {} if entry.get("parameters") is None else entry["parameters"]
    if not isinstance(raw, Mapping):
        raise InputError(
            f"{where}.parameters = {fields.show(raw)}; expected a mapping of names to numbers; write `name: number` for each"
        )
    parameters = []
    for key, value in raw.items():
        place = f"{where}.parameters.{key}"
        key = fields.text(key, f"{where}.parameters: key")
        if any(key == other for other, _ in parameters):
            raise InputError(f"{where}.parameters: {key!r} stands twice; remove one")
        if isinstance(value, list):
            parameters.append((key, fields.vector(value, place, len(value), -1e9, 1e9)))
        elif isinstance(value, str) and not fields.is_number_text(value):
            parameters.append((key, fields.text(value, place)))
        else:
            parameters.append((key, fields.number(value, place, -1e9, 1e9)))
    return Effect(
        effect=fields.text(fields.required(entry, "effect", where), f"{where}.effect"),
        target=None if target is None else fields.text(target, f"{where}.target"),
        parameters=tuple(parameters),
    )
