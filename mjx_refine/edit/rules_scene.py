"""The rules on places, removal and copies, and those on gravity and the camera."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from typing import Any

from mjx_refine.batch import geom_size
from mjx_refine.edit import amounts
from mjx_refine.edit.amounts import AMOUNT, DOWN, FACTORS, NUMBER, SET, UP, VECTOR, Kind, quantity
from mjx_refine.edit.quantities import scaled_vector
from mjx_refine.edit.rules import DIRECTION, DIRECTIONS, Step, chosen, each, rule, vector
from mjx_refine.edit.words import TARGET
from mjx_refine.errors import InputError
from mjx_refine.scene import Body, Scene

_VERBS = "|".join([*UP, *DOWN, *SET, *FACTORS, "scale", "multiply", "divide"])
_BODIES = {
    "moon": 1.62, "mars": 3.71, "earth": 9.81, "venus": 8.87, "jupiter": 24.79, "mercury": 3.7, "saturn": 10.44,
}  # fmt: skip
"""Gravity at the surface of celestial bodies [m/s^2] (NASA's planetary fact sheet)."""


def _moved(place: Any, shift: tuple[float, ...]) -> Any:
    return dataclasses.replace(place, position=tuple(a + b for a, b in zip(place.position, shift, strict=True)))


def _shift(distance: str, unit: str | None, way: str) -> tuple[float, ...]:
    length = quantity(distance, unit, "m")
    return tuple(length * v for v in DIRECTIONS[way.lower()])


@rule(rf"(?:move|shift|translate|lift|push) {TARGET} (?:by )?{AMOUNT} {DIRECTION}", "move OBJECT NUMBER m to the left")
def _move(scene: Scene, match: re.Match[str]) -> Step:
    shift = _shift(match[2], match[3], match["way"])
    return each(scene, match, lambda body: _moved(body, shift))


@rule(rf"(?:move|shift|translate) {TARGET} {DIRECTION} by {AMOUNT}", "move OBJECT up by NUMBER m")
def _move_way(scene: Scene, match: re.Match[str]) -> Step:
    shift = _shift(match[3], match[4], match["way"])
    return each(scene, match, lambda body: _moved(body, shift))


@rule(rf"(?P<verb>raise|lift|lower) {TARGET} by {AMOUNT}", "raise OBJECT by NUMBER m", "lower OBJECT by NUMBER m")
def _lift(scene: Scene, match: re.Match[str]) -> Step:
    shift = _shift(match[3], match[4], "down" if match["verb"].lower() == "lower" else "up")
    return each(scene, match, lambda body: _moved(body, shift))


@rule(rf"(?:move|shift|translate) {TARGET} by {VECTOR}(?: m)?", "move OBJECT by [X, Y, Z]")
def _move_by(scene: Scene, match: re.Match[str]) -> Step:
    return each(scene, match, lambda body: _moved(body, vector(match, 2)))


@rule(rf"(?:move|put|place|set) {TARGET} (?:to|at) {VECTOR}(?: m)?", "move OBJECT to [X, Y, Z]")
def _move_to(scene: Scene, match: re.Match[str]) -> Step:
    return each(scene, match, lambda body: dataclasses.replace(body, position=vector(match, 2)))


@rule(rf"(?:remove|delete|drop|erase|take away) {TARGET}", "remove OBJECT")
def _remove(scene: Scene, match: re.Match[str]) -> Step:
    return Step(scene, (), tuple(scene.names[k] for k in chosen(match)))


@rule(
    rf"(?:copy|duplicate|clone) {TARGET}(?: (?:as|named|called) (?P<name>\"(?:[^\"\\]|\\.)*\"|[\w-]+|@\d+))?"
    rf"(?: (?P<place>(?:at|to) {VECTOR}(?: m)?|by {VECTOR}(?: m)?|(?:by )?{AMOUNT} {DIRECTION}))?",
    "copy OBJECT", "copy OBJECT as NAME NUMBER m to the right", "copy OBJECT as NAME at [X, Y, Z]",
)  # fmt: skip
def _copy(scene: Scene, match: re.Match[str]) -> Step:
    which = chosen(match)
    if len(which) != 1:
        raise InputError("instruction: copies of several objects at once; expected one object; write one after another")
    body = scene.objects[which[0]]
    name = _new_name(scene, body) if match["name"] is None else match["name"]
    name = _unquoted(name) if name.startswith('"') else name
    name = scene.names[int(name[1:])] if re.fullmatch(r"@\d+", name) else name
    place = (match["place"] or "").lower()
    if place.startswith(("at", "to")):
        where = vector(match, 4)
    elif place.startswith("by ") and match[7]:
        where = _moved(body, vector(match, 7)).position
    elif place:
        where = _moved(body, _shift(match[10], match[11], match["way"])).position
    else:
        # Beside it, with a gap, so that neither can touch the other however they are turned.
        reach = max(geom_size(body)) if body.shape == "sphere" else math.hypot(*geom_size(body))
        where = _moved(body, (round(2 * reach + 0.1, 2), 0.0, 0.0)).position
    return Step(scene, (name,), (), (body.name, name, lambda copy: dataclasses.replace(copy, position=where)))


def _unquoted(text: str) -> str:
    try:
        return str(json.loads(text))
    except ValueError as error:
        raise InputError(
            f"instruction: the name {text} is not readable ({error}); expected a quoted text; correct it"
        ) from error


def _new_name(scene: Scene, body: Body) -> str:
    return next(name for k in range(len(scene.names) + 1) if (name := f"{body.shape}_{k}") not in scene.names)


def _with_gravity(scene: Scene, length: float) -> Step:
    down = scene.gravity if any(scene.gravity) else (0.0, 0.0, -1.0)
    return Step(dataclasses.replace(scene, gravity=scaled_vector(down, length, "gravity", "")))


@rule(
    rf"(?P<verb>{_VERBS}) gravity(?P<tail> (?:by|to) .+)?", "set gravity to NUMBER m/s^2", "reduce gravity by NUMBER%",
    "double gravity",
)  # fmt: skip
def _gravity(scene: Scene, match: re.Match[str]) -> Step | None:
    change = amounts.change(match["verb"], match["tail"] or "", Kind("m/s^2"))
    return None if change is None else _with_gravity(scene, change(math.hypot(*scene.gravity)))


@rule(rf"set gravity to {VECTOR}(?: m/s\^?2)?", "set gravity to [X, Y, Z]")
def _gravity_vector(scene: Scene, match: re.Match[str]) -> Step:
    return Step(dataclasses.replace(scene, gravity=vector(match, 1)))


@rule(r"(?:turn off|remove|switch off|disable|zero) gravity", "turn off gravity")
def _weightless(scene: Scene, match: re.Match[str]) -> Step:
    return Step(dataclasses.replace(scene, gravity=(0.0, 0.0, 0.0)))


@rule(r"(?:reverse|flip|invert) gravity", "reverse gravity")
def _reverse_gravity(scene: Scene, match: re.Match[str]) -> Step:
    x, y, z = scene.gravity
    return Step(dataclasses.replace(scene, gravity=(-x, -y, -z)))


@rule(rf"(?:use|set gravity to)(?: gravity of| that of)? (?P<body>{'|'.join(_BODIES)})(?: gravity|'s gravity)?",
      "use the gravity of the moon")  # fmt: skip
def _celestial(scene: Scene, match: re.Match[str]) -> Step:
    return _with_gravity(scene, _BODIES[match["body"].lower()])


def _with_camera(scene: Scene, **changes: Any) -> Step:
    return Step(dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, **changes)))


_PITCH = r"camera(?:'s)? (?:pitch|orientation|tilt)|(?:pitch|orientation|tilt) of camera"
_HEIGHT = r"camera(?:'s)? height|height of camera"
_FOV = r"(?:camera(?:'s)? )?(?:field of view|fov|fovy)(?: of camera)?"


@rule(
    rf"(?P<verb>{_VERBS}) (?:(?P<height>{_HEIGHT})|(?P<pitch>{_PITCH})|(?P<fovy>{_FOV}))(?P<tail> (?:by|to) .+)?",
    "set the camera height to NUMBER m", "set the camera pitch to NUMBER degrees", "set the field of view to NUMBER degrees",
    "increase the field of view by NUMBER degrees",
)  # fmt: skip
def _camera_number(scene: Scene, match: re.Match[str]) -> Step | None:
    camera = scene.camera
    change = amounts.change(
        match["verb"], match["tail"] or "", Kind("m" if match["height"] else "degree", algebraic=True)
    )
    if change is None:
        return None
    if match["height"]:
        return _with_camera(scene, position=(*camera.position[:2], change(camera.position[2])))
    if match["pitch"]:
        return _with_camera(scene, orientation=change(camera.orientation))
    return _with_camera(scene, fovy=change(camera.fovy))


@rule(rf"(?P<verb>raise|lift|lower) camera by {AMOUNT}", "raise the camera by NUMBER m", "lower the camera by NUMBER m")
def _camera_lift(scene: Scene, match: re.Match[str]) -> Step:
    shift = _shift(match[2], match[3], "down" if match["verb"].lower() == "lower" else "up")
    return _with_camera(scene, position=_moved(scene.camera, shift).position)


@rule(rf"move camera (?:by )?{AMOUNT} {DIRECTION}", "move the camera NUMBER m to the left")
def _camera_move(scene: Scene, match: re.Match[str]) -> Step:
    return _with_camera(scene, position=_moved(scene.camera, _shift(match[1], match[2], match["way"])).position)


@rule(rf"(?:move|put|place) camera (?:to|at) {VECTOR}(?: m)?", "move the camera to [X, Y, Z]")
def _camera_place(scene: Scene, match: re.Match[str]) -> Step:
    return _with_camera(scene, position=vector(match, 1))


@rule(rf"(?:tilt|pitch|turn) camera (?P<up>up|down) by {AMOUNT}", "tilt the camera up by NUMBER degrees")
def _camera_tilt(scene: Scene, match: re.Match[str]) -> Step:
    angle = quantity(match[2], match[3], "degree") * (1 if match["up"].lower() == "up" else -1)
    return _with_camera(scene, orientation=scene.camera.orientation + angle)


@rule(rf"zoom (?P<way>in|out) by ({NUMBER}) ?(?:%|percent)", "zoom in by NUMBER%")
def _zoom(scene: Scene, match: re.Match[str]) -> Step:
    """The picture of everything grows, or shrinks, by so much: the focal length does."""
    percent = float(match[2])
    factor = 1 + percent / 100 if match["way"].lower() == "in" else 1 - percent / 100
    if not 1 / amounts.MOST <= factor <= amounts.MOST:
        raise InputError(f"instruction: zoom {match['way']} by {percent:g}%; expected less than 100% out; lower it")
    half = math.atan(math.tan(math.radians(scene.camera.fovy) / 2) / factor)
    return _with_camera(scene, fovy=math.degrees(2 * half))
