"""How much: numbers with units, percentages and factors, as functions from the old value to the new one."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable

from mjx_refine.errors import InputError

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
AMOUNT = rf"({NUMBER}) ?([a-zµ°%][\w/^²°]*(?: per \w+)?)?"
VECTOR = rf"[\[(] ?({NUMBER}) ?, ?({NUMBER}) ?, ?({NUMBER}) ?[\])]"

MOST = 1e9
"""Numbers in instructions go so far."""

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "metres": 1.0, "meters": 1.0, "metre": 1.0, "meter": 1.0}
_ANGLES = {"degrees": 1.0, "degree": 1.0, "deg": 1.0, "°": 1.0}
UNITS: dict[str, dict[str, float]] = {
    "m": _METRES,
    "kg": {"kg": 1.0, "g": 0.001, "kilograms": 1.0, "grams": 0.001, "t": 1000.0},
    "m/s": {"m/s": 1.0, "cm/s": 0.01, "km/h": 1 / 3.6, "mm/s": 0.001},
    "rad/s": {
        "rad/s": 1.0, "deg/s": math.pi / 180, "°/s": math.pi / 180, "degrees per second": math.pi / 180,
        "rpm": math.pi / 30, "rev/s": 2 * math.pi,
    },
    "m/s^2": {"m/s^2": 1.0, "m/s²": 1.0, "m/s2": 1.0, "g": 9.81},
    "degree": _ANGLES,
    "1/s": {"1/s": 1.0},
    "1/s^2": {"1/s^2": 1.0},
    "": {},
}  # fmt: skip
"""Units by dimension, the name of which is the unit of the scene file."""

_TIMES = {"twice": 2.0, "double": 2.0, "half": 0.5, "thrice": 3.0, "triple": 3.0, "third": 1 / 3, "quarter": 0.25}
UP = ("increase", "raise", "boost", "enlarge", "grow", "widen", "extend", "add to")
DOWN = ("reduce", "decrease", "lower", "cut", "shrink", "lessen", "narrow", "diminish")
SET = ("set", "change", "make", "bring", "fix", "put")
FACTORS = {"double": 2.0, "triple": 3.0, "quadruple": 4.0, "halve": 0.5, "quarter": 0.25}
Change = Callable[[float], float]


@dataclasses.dataclass(frozen=True)
class Kind:
    """What kind of number a change is of.

    Attributes:
      unit: of the scene file; a key of ``UNITS``.
      relative: it can only be scaled.
      algebraic: ``increase by 1`` adds to the number itself (a place), not to its magnitude (a velocity).
      sign: of a number that is 0 now.
    """

    unit: str
    relative: bool = False
    algebraic: bool = False
    sign: float = 1.0


def quantity(text: str, unit: str | None, dimension: str) -> float:
    """A number in the scene file's unit.

    Raises:
      InputError: the unit is of something else.
    """
    if not abs(float(text)) <= MOST:
        raise InputError(f"instruction: {text}; expected a number up to {MOST:g}; lower it")
    if unit is None:
        return float(text)
    known = UNITS[dimension]
    if unit.lower() not in known:
        raise InputError(
            f"instruction: {text} {unit}: expected {', '.join(known) or 'a number without a unit'}; correct the unit"
        )
    return float(text) * known[unit.lower()]


def change(verb: str, tail: str, kind: Kind) -> Change | None:
    """What ``verb`` and ``tail`` ("by 80%", "to 3 m/s") make of a number; None where they are not understood.

    Raises:
      InputError: a unit does not fit, or the amount makes no sense.
    """
    verb, tail = verb.lower(), tail.strip().lower()
    if verb in FACTORS:
        return None if tail else lambda value: FACTORS[verb] * value
    if tail in ("by half", "by one half") and verb in (*UP, *DOWN):
        return lambda value: value * (1.5 if verb in UP else 0.5)
    match = re.fullmatch(rf"(?:to|by) ({'|'.join(_TIMES)})(?: of (?:what it was|its value|before))?", tail)
    if match and tail.startswith("to") and verb in (*UP, *DOWN, *SET, "scale"):
        return lambda value: _TIMES[match[1]] * value
    match = re.fullmatch(rf"by (?:factor (?:of )?)?({NUMBER})(?: times)?", tail)
    if match and (verb in ("scale", "multiply", "divide") or "factor" in tail) and verb not in SET:
        return _scaled(float(match[1]), verb in (*DOWN, "divide"))
    match = re.fullmatch(rf"(by|to) {AMOUNT}(?: of (?:what it was|its value|before))?", tail)
    if match is None:
        return None
    if match[3] in ("%", "percent"):
        return _percentage(verb, match[1], float(match[2]))
    if kind.relative or verb in ("scale", "multiply", "divide"):
        return None
    if match[1] == "to":
        return _to(quantity(match[2], match[3], kind.unit)) if verb in (*UP, *DOWN, *SET) else None
    if verb in (*UP, *DOWN):
        return _by(quantity(match[2], match[3], kind.unit) * (1 if verb in UP else -1), kind)
    return None


def _to(target: float) -> Change:
    return lambda _: target


def _scaled(factor: float, inverse: bool) -> Change:
    if not 1 / MOST <= factor <= MOST:
        raise InputError(f"instruction: a factor of {factor:g}; expected one above 0 and up to {MOST:g}; correct it")
    return lambda value: value / factor if inverse else value * factor


def _percentage(verb: str, word: str, percent: float) -> Change | None:
    if not 0 <= percent <= MOST or (verb in DOWN and word == "by" and percent > 100):
        raise InputError(
            f"instruction: {verb} {word} {percent:g}%; expected 0 to {'100' if verb in DOWN else 'any'} percent; correct it"
        )
    if word == "to" or verb in ("scale", "multiply"):
        factor = percent / 100
    elif verb in (*UP, *DOWN):
        factor = 1 + percent / 100 if verb in UP else 1 - percent / 100
    else:
        return None
    return lambda value: value * factor


def _by(more: float, kind: Kind) -> Change:
    def by(value: float) -> float:
        if kind.algebraic:
            return value + more
        sign = math.copysign(1.0, value) if value else kind.sign
        if abs(value) + more < 0:
            raise InputError(
                f"instruction: {abs(value):g} reduced by {-more:g} {kind.unit}; expected at most {abs(value):g}; lower the amount"
            )
        return sign * (abs(value) + more)

    return by
