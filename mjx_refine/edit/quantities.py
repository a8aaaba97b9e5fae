"""The numbers of an object that instructions can name: how each is read from a body and put back."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_refine import rotations
from mjx_refine.edit.amounts import Kind
from mjx_refine.errors import InputError
from mjx_refine.scene import Body

_AXES = ("x", "y", "z")


@dataclasses.dataclass(frozen=True)
class Quantity:
    """One number of a body.

    Attributes:
      names: regular expressions of what it is called, without articles.
      kind: its unit and how amounts act on it.
      get: its value.
      put: the body with another value.
    """

    names: tuple[str, ...]
    kind: Kind
    get: Callable[[Body], float]
    put: Callable[[Body, float], Body]


def with_component(body: Any, field: str, index: int, value: float) -> Any:
    """``body`` with one number of a vector changed."""
    vector = list(getattr(body, field))
    vector[index] = value
    return dataclasses.replace(body, **{field: tuple(vector)})


def _component(names: tuple[str, ...], unit: str, field: str, index: int, algebraic: bool = False) -> Quantity:
    return Quantity(
        names,
        Kind(unit, algebraic=algebraic),
        lambda body: getattr(body, field)[index],
        lambda body, value: with_component(body, field, index, value),
    )


def _axis_names(axis: str, *words: str) -> tuple[str, ...]:
    after = f"(?:along|in|about) {axis}(?:[- ]axis|[- ]direction)?"
    return tuple(pattern for word in words for pattern in (f"{axis}[- ]{word}", f"{word} {after}"))


def scaled_vector(vector: tuple[float, ...], length: float, what: str, remedy: str) -> tuple[float, ...]:
    """``vector`` with another length.

    Raises:
      InputError: it has no direction, or the length is negative.
    """
    old = math.hypot(*vector)
    if length < 0:
        raise InputError(f"instruction: {what} = {length:g}; expected 0 or more; to turn it round, reverse it")
    if old == 0 and length > 0:
        raise InputError(f"instruction: {what} is 0 and has no direction; expected one; {remedy}")
    return tuple(v * length / old for v in vector) if old else vector


def _length(names: tuple[str, ...], unit: str, field: str, what: str, remedy: str, count: int = 3) -> Quantity:
    def put(body: Body, value: float) -> Body:
        vector = getattr(body, field)
        part = scaled_vector(vector[:count], value, f"{body.name}'s {what}", remedy.format(name=body.name))
        return dataclasses.replace(body, **{field: (*part, *vector[count:])})

    return Quantity(names, Kind(unit), lambda body: math.hypot(*getattr(body, field)[:count]), put)


def _field(names: tuple[str, ...], unit: str, field: str, sign: float = 1.0) -> Quantity:
    return Quantity(
        names,
        Kind(unit, sign=sign),
        lambda body: getattr(body, field),
        lambda body, value: dataclasses.replace(body, **{field: value}),
    )


def half_height(body: Body) -> float:
    """How far a body reaches below its centre [m]."""
    up = np.abs(rotations.matrix(np.array(body.orientation))[2])
    if body.shape == "sphere":
        return body.size[0]
    if body.shape == "cylinder":
        return float(up[2] * body.size[1] / 2 + body.size[0] * math.sqrt(max(0.0, 1.0 - up[2] ** 2)))
    return float(up @ np.array(body.size))


def resized(body: Body, size: tuple[float, ...]) -> Body:
    """``body`` with another size; one that stood on the floor still does."""
    changed = dataclasses.replace(body, size=size)
    if any(value <= 0 for value in size):
        raise InputError(
            f"instruction: {body.name}'s size = {list(size)}; expected lengths above 0; correct the amount"
        )
    if abs(body.position[2] - half_height(body)) < 1e-3:
        return with_component(changed, "position", 2, body.position[2] + half_height(changed) - half_height(body))
    return changed


def _extent(names: tuple[str, ...], which: dict[str, tuple[int, float]], what: str) -> Quantity:
    """A length of a body: by shape, the index in its size, and how many of it make the length."""

    def entry(body: Body) -> tuple[int, float]:
        if body.shape not in which:
            raise InputError(
                f"instruction: {body.name} is a {body.shape} and has no {what}; expected a {' or a '.join(which)}; "
                f"make it bigger or smaller"
            )
        return which[body.shape]

    def put(body: Body, value: float) -> Body:
        index, many = entry(body)
        size = list(body.size)
        size[index] = value / many
        return resized(body, tuple(size))

    return Quantity(names, Kind("m"), lambda body: body.size[entry(body)[0]] * entry(body)[1], put)


def _softened(body: Body, factor: float) -> Body:
    if factor <= 0:
        raise InputError(f"instruction: bounce times {factor:g}; expected a factor above 0; set the damping instead")
    return dataclasses.replace(body, damping=body.damping / factor)


_LAUNCH = 'say "launch {name} to the left at 2 m/s"'
_SPIN = 'say "spin {name} about z at 2 rad/s"'
QUANTITIES: tuple[Quantity, ...] = (
    *(
        _component(_axis_names(axis, "velocity", "speed", "component of velocity"), "m/s", "linear_velocity", k)
        for k, axis in enumerate(_AXES)
    ),
    *(
        _component(_axis_names(axis, "spin", "angular velocity", "rotation"), "rad/s", "angular_velocity", k)
        for k, axis in enumerate(_AXES)
    ),
    *(
        _component(_axis_names(axis, "position", "coordinate"), "m", "position", k, True)
        for k, axis in enumerate(_AXES)
    ),
    _component(("vertical (?:velocity|speed)", "upward (?:velocity|speed)"), "m/s", "linear_velocity", 2),
    _length(("horizontal (?:velocity|speed)",), "m/s", "linear_velocity", "horizontal speed", _LAUNCH, 2),
    _length(("velocity", "speed", "linear velocity"), "m/s", "linear_velocity", "speed", _LAUNCH),
    _length(
        ("spin", "spin rate", "angular velocity", "angular speed", "rotation"),
        "rad/s",
        "angular_velocity",
        "spin",
        _SPIN,
    ),
    _field(("mass", "weight"), "kg", "mass"),
    _field(("damping", "contact damping"), "1/s", "damping", -1.0),
    _field(("stiffness", "contact stiffness"), "1/s^2", "stiffness"),
    _component(("friction", "sliding friction", "friction coefficient"), "", "friction", 0),
    _component(("rolling friction", "rolling resistance"), "m", "friction", 1),
    Quantity(("bounce", "bounciness", "elasticity"), Kind("", relative=True), lambda _: 1.0, _softened),
    Quantity(
        ("size", "scale", "dimensions"),
        Kind("", relative=True),
        lambda _: 1.0,
        lambda body, factor: resized(body, tuple(v * factor for v in body.size)),
    ),
    _extent(("radius",), {"sphere": (0, 1.0), "cylinder": (0, 1.0)}, "radius"),
    _extent(("diameter",), {"sphere": (0, 2.0), "cylinder": (0, 2.0)}, "diameter"),
    _extent(("height",), {"cylinder": (1, 1.0), "box": (2, 2.0)}, "height"),
    _extent(("width",), {"box": (0, 2.0)}, "width"),
    _extent(("depth", "length"), {"box": (1, 2.0)}, "depth"),
)
"""All of them. A box's width, depth and height are its whole extents along its own x, y and z."""

NAMES = "|".join(name for item in QUANTITIES for name in item.names)


def quantity_called(name: str) -> Quantity:
    """The quantity that ``NAMES`` matched."""
    return next(q for q in QUANTITIES for n in q.names if re.fullmatch(n, name, re.IGNORECASE))
