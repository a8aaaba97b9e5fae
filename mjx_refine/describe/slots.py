"""The parts of a sentence that vary: how each kind of value is written, and how it is read back."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_refine.describe.classes import DIRECTIONS, PACES, PLACES
from mjx_refine.scene import SHAPES

# A name that ends in a digit cannot be mistaken for a word of the sentence; any other is quoted.
_PLAIN = re.compile(r"[^\W\d]\w*\d")
_QUOTED = r'"(?:[^"\\]|\\.)*"'
NAME = rf"(?:{_PLAIN.pattern}|{_QUOTED})"
_NUMBER = r"-?\d+\.\d\d"
_WHEN = {
    "start": ("at the start", "in the first frame", "initially"),
    "end": ("at the end", "in the last frame", "finally"),
}


@dataclasses.dataclass(frozen=True)
class Slot:
    """One kind of value in a sentence.

    Attributes:
      pattern: regular expression of its text, without groups.
      write: from the value, with a source of randomness, to the text.
      read: from the text to the value; a ValueError where the text contradicts itself.
    """

    pattern: str
    write: Callable[[Any, np.random.Generator], str]
    read: Callable[[str], Any]


def name_text(name: str) -> str:
    """A name as it stands in a sentence."""
    # "<" would end the thoughts in the middle of a name.
    return name if _PLAIN.fullmatch(name) else json.dumps(name, ensure_ascii=False).replace("<", "\\u003c")


def read_name(text: str) -> str:
    """The name that ``name_text`` wrote; ``it`` stays."""
    return json.loads(text) if text.startswith('"') else text


def joined(parts: list[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def _list(pattern: str) -> str:
    return rf"{pattern}(?:, {pattern})*(?: and {pattern})?"


def _words(words) -> Slot:
    # The longest first, so that "to the right, rising" is not read as "to the right".
    options = sorted(words, key=len, reverse=True)
    return Slot("(?:" + "|".join(map(re.escape, options)) + ")", lambda value, _: value, str)


def _when(change: Callable[[str], str]) -> Slot:
    told = {change(text): when for when, texts in _WHEN.items() for text in texts}

    def write(value: str, rng: np.random.Generator) -> str:
        return change(str(rng.choice(_WHEN[value])))

    return Slot("(?:" + "|".join(told) + ")", write, told.__getitem__)


_ITEM = rf"{NAME} \((?:{'|'.join(SHAPES)})\)"
_SPAN = rf"from {_NUMBER} s to {_NUMBER} s"


def _read_objects(text: str) -> tuple[tuple[str, str], ...]:
    found = re.findall(rf"({NAME}) \((\w+)\)", text)
    return tuple((read_name(name), shape) for name, shape in found)


def _objects_text(objects: tuple[tuple[str, str], ...], _: object = None) -> str:
    return joined([f"{name_text(name)} ({shape})" for name, shape in objects])


def _read_counted(text: str) -> tuple[tuple[str, str], ...]:
    number, listed = text.split(": ", 1)
    objects = _read_objects(listed)
    if int(number.split()[0]) != len(objects):
        raise ValueError(f"{number} are announced, {len(objects)} are named")
    return objects


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(v) for v in re.findall(_NUMBER, text))


def _read_spans(text: str) -> tuple[tuple[float, float], ...]:
    flat = _numbers(text)
    return tuple(zip(flat[::2], flat[1::2], strict=True))


SLOTS: dict[str, Slot] = {
    "name": Slot(NAME, lambda value, _: name_text(value), read_name),
    "number": Slot(_NUMBER, lambda value, _: f"{value:.2f}", float),
    "rate": Slot(r"[\d.]+(?:e[+-]\d+)?", lambda value, _: f"{value:g}", float),
    "integer": Slot(r"\d+", lambda value, _: str(value), int),
    "x": _words(PLACES["x"]),
    "y": _words(PLACES["y"]),
    "z": _words(PLACES["z"]),
    "pace": _words(word for word, _ in PACES),
    "direction": _words(DIRECTIONS),
    "when": _when(str),
    "When": _when(str.capitalize),
    "times": Slot(
        _list(rf"{_NUMBER} s"), lambda value, _: joined([f"{v:.2f} s" for v in value]), lambda text: _numbers(text)
    ),
    "spans": Slot(
        _list(_SPAN), lambda value, _: joined([f"from {a:.2f} s to {b:.2f} s" for a, b in value]), _read_spans
    ),
    "objects": Slot(_list(_ITEM), _objects_text, _read_objects),
    "counted": Slot(
        rf"\d+ objects?: {_list(_ITEM)}",
        lambda value, _: f"{len(value)} object{'s' * (len(value) != 1)}: {_objects_text(value)}",
        _read_counted,
    ),
}
"""Every kind of slot by the name that templates give it."""
