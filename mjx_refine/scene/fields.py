"""Reading one value of a configuration, with an error that says where it stood."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mjx_refine.errors import InputError

# Nested aliases make a short text's value astronomically long, so that its whole repr must never be made.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxdict, _SHORT.maxlist, _SHORT.maxtuple, _SHORT.maxset = 3, 4, 4, 4, 4
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def show(value: object) -> str:
    """A value, short enough for an error's one line."""
    try:
        text = _SHORT.repr(value)
    except ValueError:  # Python refuses to print whole numbers of thousands of digits
        text = f"a {type(value).__name__} too long to print"
    return cut(text, 60)


def cut(text: str, most: int = 200) -> str:
    """A text, short enough for an error's one line."""
    return text if len(text) <= most else text[: most - 3] + "..."


def mapping(value: object, place: str, allowed: Iterable[str]) -> Mapping[str, Any]:
    """``value`` as a mapping with only ``allowed`` keys."""
    allowed = tuple(allowed)
    if not isinstance(value, Mapping):
        raise InputError(
            f"{place} = {show(value)}; expected a mapping with the keys {', '.join(allowed)}; write `key: value` for each"
        )
    for key in value:
        if key not in allowed:
            raise InputError(
                f"{place}: unknown key {show(key)}; expected one of {', '.join(allowed)}; remove or rename it"
            )
    return value


def is_number_text(value: object) -> bool:
    """Whether ``value`` is a text that spells a number."""
    return isinstance(value, str) and _NUMBER.fullmatch(value.strip()) is not None


def number(
    value: object,
    place: str,
    low: float = -1e6,
    high: float = 1e6,
    *,
    above: bool = False,
) -> float:
    """``value`` as a finite float in [low, high], or in (low, high] where ``above``."""
    expectation = f"expected a number, {low:g} {'<' if above else '<='} number <= {high:g}"
    # YAML 1.1 reads 1e-3 (no dot) as text.
    if is_number_text(value):
        value = float(value)  # type: ignore[arg-type]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{place} = {show(value)}; {expectation}; correct the value")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or result > high or result < low or (above and result <= low):
        raise InputError(f"{place} = {show(value)}; {expectation}; correct the value")
    return result + 0.0  # -0.0 becomes 0.0


def vector(value: object, place: str, length: int, low: float = -1e6, high: float = 1e6, *, above: bool = False) -> Any:
    """``value`` as a tuple of ``length`` numbers in [low, high]."""
    if isinstance(value, str | bytes) or not isinstance(value, Sequence) or len(value) != length:
        raise InputError(f"{place} = {show(value)}; expected a list of {length} numbers; give them as [..., ...]")
    return tuple(number(v, f"{place}[{i}]", low, high, above=above) for i, v in enumerate(value))


def required(source: Mapping[str, Any], key: str, place: str) -> object:
    """``source[key]``, which has no safe default."""
    if key not in source or source[key] is None:
        raise InputError(f"{place}.{key} is missing; it has no safe default; add it")
    return source[key]


def text(value: object, place: str) -> str:
    """``value`` as one printable word or line of at most 200 characters."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = str(value)
    if not isinstance(value, str) or not value.strip() or len(value) > 200 or not value.isprintable():
        raise InputError(f"{place} = {show(value)}; expected a printable text of 1 to 200 characters; rename it")
    if "<answer>" in value or "<think>" in value:
        raise InputError(f"{place} = {show(value)}; expected a text without <answer> and <think>; rename it")
    return value.strip()
