"""The rules on objects: every form of an instruction that is understood, and what it makes of a scene."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable

from mjx_refine.edit import amounts
from mjx_refine.edit.amounts import AMOUNT, DOWN, FACTORS, SET, UP, VECTOR, quantity
from mjx_refine.edit.quantities import NAMES, quantity_called
from mjx_refine.edit.words import TARGET
from mjx_refine.errors import InputError
from mjx_refine.scene import Body, Scene


@dataclasses.dataclass(frozen=True)
class Step:
    """What one instruction does.

    Attributes:
      scene: afterwards, without removals and copies.
      about: names of the objects that it is about.
      removed: names of objects to remove.
      copied: (name, new name, how the copy differs), at most one.
    """

    scene: Scene
    about: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    copied: tuple[str, str, Callable[[Body], Body]] | None = None


Rule = Callable[[Scene, re.Match[str]], Step | None]
RULES: list[tuple[re.Pattern[str], Rule]] = []
FORMS: list[str] = []
"""Every form with OBJECT, QUANTITY, NUMBER and the like in place of what varies, to be shown to who was not understood."""

DIRECTIONS: dict[str, tuple[float, ...]] = {
    "to left": (-1, 0, 0), "left": (-1, 0, 0), "to right": (1, 0, 0), "right": (1, 0, 0), "up": (0, 0, 1), "upwards": (0, 0, 1),
    "upward": (0, 0, 1), "down": (0, 0, -1), "downwards": (0, 0, -1), "downward": (0, 0, -1), "to back": (0, 1, 0),
    "away from camera": (0, 1, 0), "to front": (0, -1, 0), "towards camera": (0, -1, 0), "toward camera": (0, -1, 0),
    **{f"along {sign}{axis}": tuple((-1.0 if sign == "-" else 1.0) * (k == n) for k in range(3))
       for n, axis in enumerate("xyz") for sign in ("", "+", "-")},
}  # fmt: skip
"""Directions in words without articles: to the back is +y, to the front -y, up +z."""
DIRECTION = f"(?P<way>{'|'.join(re.escape(way) for way in sorted(DIRECTIONS, key=len, reverse=True))})"
_VERBS = "|".join([*UP, *DOWN, *SET, *FACTORS, "scale", "multiply", "divide"])


def rule(pattern: str, *forms: str) -> Callable[[Rule], Rule]:
    """Registers a rule for clauses that match ``pattern`` as a whole."""

    def register(function: Rule) -> Rule:
        RULES.append((re.compile(pattern, re.IGNORECASE), function))
        FORMS.extend(forms)
        return function

    return register


def chosen(match: re.Match[str]) -> list[int]:
    """Indices of the objects that a clause is about."""
    return sorted({int(k) for k in match["who"][1:].split(",")})


def each(scene: Scene, match: re.Match[str], make: Callable[[Body], Body]) -> Step:
    """The step that changes every object of the clause."""
    which = chosen(match)
    bodies = tuple(make(body) if k in which else body for k, body in enumerate(scene.objects))
    return Step(dataclasses.replace(scene, objects=bodies), tuple(scene.names[k] for k in which))


def vector(match: re.Match[str], start: int) -> tuple[float, float, float]:
    """The three numbers of the ``VECTOR`` whose first group is ``start``."""
    x, y, z = (quantity(match[start + k], None, "") for k in range(3))
    return x, y, z


@rule(
    rf"(?P<verb>{_VERBS}) (?P<what>{NAMES}) of {TARGET}(?P<tail> (?:by|to) .+)?",
    "reduce the QUANTITY of OBJECT by NUMBER%",
    "increase the QUANTITY of OBJECT by NUMBER m/s",
    "set the QUANTITY of OBJECT to NUMBER",
    "double the QUANTITY of OBJECT",
    "scale the QUANTITY of OBJECT by a factor of NUMBER",
    "reduce the x-velocity of OBJECT by NUMBER%",
    "set the speed of OBJECT to NUMBER m/s",
    "set the mass of OBJECT to NUMBER kg",
    "increase the size of OBJECT by NUMBER%",
    "set the friction of OBJECT to NUMBER",
    "set the rolling friction of OBJECT to NUMBER",
    "set the damping of OBJECT to NUMBER",
    "increase the bounce of OBJECT by NUMBER%",
    "set the radius of OBJECT to NUMBER m",
)
def _quantity(scene: Scene, match: re.Match[str]) -> Step | None:
    item = quantity_called(match["what"])
    change = amounts.change(match["verb"], match["tail"] or "", item.kind)
    if change is None:
        return None
    return each(scene, match, lambda body: item.put(body, change(item.get(body))))


@rule(
    rf"(?P<verb>scale|enlarge|grow|shrink|double|halve|triple) {TARGET}(?P<tail> (?:by|to) .+)?",
    "scale OBJECT by NUMBER%",
)
def _scale(scene: Scene, match: re.Match[str]) -> Step | None:
    item = quantity_called("size")
    change = amounts.change(match["verb"], match["tail"] or "", item.kind)
    return None if change is None else each(scene, match, lambda body: item.put(body, change(1.0)))


@rule(rf"set (?P<what>velocity|linear velocity|spin|angular velocity|position) of {TARGET} to {VECTOR}(?: [a-z/]+)?",
      "set the velocity of OBJECT to [X, Y, Z]", "set the spin of OBJECT to [X, Y, Z]",
      "set the position of OBJECT to [X, Y, Z]")  # fmt: skip
def _vector(scene: Scene, match: re.Match[str]) -> Step:
    fields = {"position": "position", "spin": "angular_velocity", "angular velocity": "angular_velocity"}
    field = fields.get(match["what"].lower(), "linear_velocity")
    return each(scene, match, lambda body: dataclasses.replace(body, **{field: vector(match, 3)}))


@rule(rf"(?:reverse|flip|invert|negate) (?P<what>{NAMES}) of {TARGET}", "reverse the velocity of OBJECT",
      "reverse the spin of OBJECT")  # fmt: skip
def _reverse(scene: Scene, match: re.Match[str]) -> Step | None:
    name = match["what"].lower()
    item = quantity_called(name)
    if item.kind.unit not in ("m/s", "rad/s"):
        return None
    if item.get is quantity_called("velocity").get or item.get is quantity_called("spin").get:
        field = "linear_velocity" if item.kind.unit == "m/s" else "angular_velocity"
        return each(scene, match, lambda b: dataclasses.replace(b, **{field: tuple(-v for v in getattr(b, field))}))
    if name.startswith("horizontal"):
        return each(scene, match, lambda b: dataclasses.replace(
            b, linear_velocity=(-b.linear_velocity[0], -b.linear_velocity[1], b.linear_velocity[2])))  # fmt: skip
    return each(scene, match, lambda body: item.put(body, -item.get(body)))


@rule(rf"(?:stop|remove|cancel|zero|kill) (?P<what>spin|rotation|velocity|angular velocity) of {TARGET}",
      "stop the spin of OBJECT")  # fmt: skip
def _no_part(scene: Scene, match: re.Match[str]) -> Step:
    field = "linear_velocity" if match["what"].lower() == "velocity" else "angular_velocity"
    return each(scene, match, lambda body: dataclasses.replace(body, **{field: (0.0, 0.0, 0.0)}))


@rule(
    rf"(?:stop {TARGET}|let (?P<other>@\d+(?:,\d+)*) (?:start|begin) at rest)",
    "stop OBJECT",
    "let OBJECT start at rest",
)
def _stop(scene: Scene, match: re.Match[str]) -> Step:
    which = [int(k) for k in (match["who"] or match["other"])[1:].split(",")]
    still = {"linear_velocity": (0.0, 0.0, 0.0), "angular_velocity": (0.0, 0.0, 0.0)}
    bodies = tuple(dataclasses.replace(b, **still) if k in which else b for k, b in enumerate(scene.objects))
    return Step(dataclasses.replace(scene, objects=bodies), tuple(scene.names[k] for k in which))


@rule(rf"(?:launch|throw|send|shoot|kick) {TARGET} {DIRECTION} (?:at|with) {AMOUNT}",
      "launch OBJECT to the left at NUMBER m/s")  # fmt: skip
def _launch(scene: Scene, match: re.Match[str]) -> Step:
    speed = quantity(match[3], match[4], "m/s")
    way = DIRECTIONS[match["way"].lower()]
    return each(scene, match, lambda body: dataclasses.replace(body, linear_velocity=tuple(speed * v for v in way)))


@rule(rf"(?:make|let) {TARGET} (?:move|go|fly|slide|roll|travel|head) {DIRECTION}(?: (?:at|with) {AMOUNT})?",
      "make OBJECT move to the right", "make OBJECT move up at NUMBER m/s")  # fmt: skip
def _heading(scene: Scene, match: re.Match[str]) -> Step:
    way = DIRECTIONS[match["way"].lower()]

    def turned(body: Body) -> Body:
        speed = math.hypot(*body.linear_velocity) if match[3] is None else quantity(match[3], match[4], "m/s")
        if speed == 0 and match[3] is None:
            raise InputError(f"instruction: {body.name} does not move; expected a speed; add one, such as `at 2 m/s`")
        return dataclasses.replace(body, linear_velocity=tuple(speed * v for v in way))

    return each(scene, match, turned)


@rule(rf"(?:turn|rotate) (?:velocity|direction) of {TARGET} by {AMOUNT}(?: (?P<side>to left|to right|left|right|clockwise|"
      r"counterclockwise|counter-clockwise))?", "turn the velocity of OBJECT by NUMBER degrees to the left")  # fmt: skip
def _turn(scene: Scene, match: re.Match[str]) -> Step:
    angle = math.radians(quantity(match[2], match[3], "degree"))
    angle *= -1 if (match["side"] or "").lower() in ("to right", "right", "clockwise") else 1

    def turned(body: Body) -> Body:
        x, y, z = body.linear_velocity
        return dataclasses.replace(body, linear_velocity=(
            x * math.cos(angle) - y * math.sin(angle), x * math.sin(angle) + y * math.cos(angle), z))  # fmt: skip

    return each(scene, match, turned)


@rule(rf"spin {TARGET} (?:at {AMOUNT} about (?P<first>[xyz])|about (?P<second>[xyz])(?: axis)? at {AMOUNT})(?:[- ]axis)?",
      "spin OBJECT about z at NUMBER rad/s")  # fmt: skip
def _spin(scene: Scene, match: re.Match[str]) -> Step:
    axis = (match["first"] or match["second"]).lower()
    rate = quantity(*((match[2], match[3]) if match["first"] else (match[6], match[7])), "rad/s")
    return each(
        scene, match, lambda b: dataclasses.replace(b, angular_velocity=tuple(rate * (a == axis) for a in "xyz"))
    )


_ADJECTIVES = {
    "heavy": ("mass", 1), "light": ("mass", -1), "fast": ("velocity", 1), "slow": ("velocity", -1), "big": ("size", 1),
    "large": ("size", 1), "small": ("size", -1), "bouncy": ("bounce", 1), "slippery": ("friction", -1), "rough": ("friction", 1),
    "tall": ("height", 1), "wide": ("width", 1),
}  # fmt: skip
_COMPARATIVES = {
    "heavier": "heavy", "lighter": "light", "faster": "fast", "slower": "slow", "bigger": "big", "larger": "big",
    "smaller": "small", "bouncier": "bouncy", "rougher": "rough", "taller": "tall", "wider": "wide",
    "more bouncy": "bouncy", "more slippery": "slippery", "less bouncy": "-bouncy", "less slippery": "-slippery",
    "shorter": "-tall", "narrower": "-wide",
}  # fmt: skip


def _adjective(word: str) -> tuple[str, int]:
    name, sign = _ADJECTIVES[word.removeprefix("-")]
    return name, -sign if word.startswith("-") else sign


@rule(rf"make {TARGET} (?:(?P<times>twice|half|thrice)|(?P<n>{amounts.NUMBER}) times) as (?P<word>{'|'.join(_ADJECTIVES)})",
      "make OBJECT twice as heavy", "make OBJECT NUMBER times as fast")  # fmt: skip
def _times_as(scene: Scene, match: re.Match[str]) -> Step:
    factor = {"twice": 2.0, "half": 0.5, "thrice": 3.0}[match["times"].lower()] if match["times"] else float(match["n"])
    name, sign = _adjective(match["word"].lower())
    item = quantity_called(name)
    if not 1 / amounts.MOST <= factor <= amounts.MOST:
        raise InputError(f"instruction: {factor:g} times as {match['word']}; expected a factor above 0; correct it")
    return each(scene, match, lambda body: item.put(body, item.get(body) * factor**sign))


@rule(rf"make {TARGET} (?:(?P<first>{'|'.join(_COMPARATIVES)}) by (?P<n>{amounts.NUMBER}) ?(?:%|percent)"
      rf"|(?P<m>{amounts.NUMBER}) ?(?:%|percent) (?P<second>{'|'.join(_COMPARATIVES)}))",
      "make OBJECT heavier by NUMBER%", "make OBJECT NUMBER% smaller")  # fmt: skip
def _comparative(scene: Scene, match: re.Match[str]) -> Step | None:
    name, sign = _adjective(_COMPARATIVES[(match["first"] or match["second"]).lower()])
    item = quantity_called(name)
    change = amounts.change("increase" if sign > 0 else "reduce", f"by {match['n'] or match['m']}%", item.kind)
    return None if change is None else each(scene, match, lambda body: item.put(body, change(item.get(body))))


@rule(rf"make {TARGET} frictionless", "make OBJECT frictionless")
def _frictionless(scene: Scene, match: re.Match[str]) -> Step:
    return each(scene, match, lambda body: dataclasses.replace(body, friction=(0.0, body.friction[1])))
