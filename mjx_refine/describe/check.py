"""Whether what a description says is true of a recorded simulation.

Each statement is held against the record by its definition, without the rules that made it: a claim about spans asks
every state whether it agrees, a class of places is an interval.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_refine.describe import statements as s
from mjx_refine.describe.classes import BORDERS, HEADINGS, PACES, PLACES, STEEP, STILL, TILTED
from mjx_refine.describe.parse import Parsed, parse_description
from mjx_refine.describe.record import Record, record
from mjx_refine.describe.tell import reach

HALF = 0.005 + 1e-6
"""Numbers are written with two decimals: how far the true one may be."""


@dataclasses.dataclass(frozen=True)
class Fault:
    """Something false, or not understood.

    Attributes:
      said: the sentence, or the statement where there is none.
      reason: what is wrong.
    """

    said: str
    reason: str


def check_description(text: str, source: str = "<description>") -> tuple[Parsed, tuple[Fault, ...]]:
    """Reads a description, simulates its own answer with the frames, rate and size that it tells, and checks every word.

    Raises:
      InputError: it is no description, or its scene cannot be simulated.
    """
    parsed, scene = parse_description(text, source)
    clip = next((told for told in parsed.statements if isinstance(told, s.Clip)), s.Clip(30, 30.0, 480, 320))
    return parsed, faults(parsed, record(scene, clip.frames, clip.fps, (clip.width, clip.height)))


def faults(parsed: Parsed, seen: Record) -> tuple[Fault, ...]:
    """All that is false or was not understood."""
    found = [Fault(sentence, reason) for sentence, reason in parsed.problems]
    reasons = check_statements(parsed.statements, seen)
    found += [Fault(parsed.sentences[k], reason) for k, reason in reasons.items()]
    return tuple(found)


def check_statements(told: Sequence[s.Statement], seen: Record) -> dict[int, str]:
    """Which statements are false, by index, and why."""
    wrong = {}
    for index, statement in enumerate(told):
        if isinstance(statement, s.NobodyMeets | s.NobodyElseMeets):
            reason = _nobody_else(statement, told, seen)
        else:
            unknown = _names(statement) - set(seen.scene.names)
            reason = (
                f"there is no {', '.join(sorted(unknown))}" if unknown else _CHECKS[type(statement)](statement, seen)
            )
        if reason:
            wrong[index] = reason
    return wrong


def _names(statement: Any) -> set[str]:
    return {getattr(statement, field) for field in ("object", "first", "second")
            if isinstance(getattr(statement, field, None), str)}  # fmt: skip


def _near(said: float, true: float, what: str) -> str:
    return "" if abs(said - true) <= HALF else f"{what} is {true:.4f}"


def _first(*reasons: str) -> str:
    return next((reason for reason in reasons if reason), "")


def _index(seen: Record, name: str) -> int:
    return seen.scene.names.index(name)


def _clip(told: s.Clip, seen: Record) -> str:
    right = (told.frames, told.width, told.height) == (seen.frames, *seen.size)
    return (
        ""
        if right and math.isclose(told.fps, seen.fps, rel_tol=1e-5)
        else f"{seen.frames} of {seen.size} at {seen.fps}"
    )


def _objects(told: s.Objects, seen: Record) -> str:
    true = {(body.name, body.shape) for body in seen.scene.objects}
    return "" if set(told.objects) == true and len(told.objects) == len(true) else f"the objects are {sorted(true)}"


def _gravity(told: s.Gravity, seen: Record) -> str:
    x, y, z = seen.scene.gravity
    return _first(_near(told.x, x, "x"), _near(told.y, y, "y"), _near(told.z, z, "z"))


def _view(told: s.View, seen: Record) -> str:
    camera = seen.scene.camera
    return _first(
        _near(told.height, camera.position[2], "the height"),
        _near(told.pitch, camera.orientation, "the pitch"),
        _near(told.fovy, camera.fovy, "the field of view"),
    )


def _seen(told: s.Seen | s.NeverSeen, seen: Record) -> str:
    shown = [t for t in range(seen.frames) if seen.pixels[t, _index(seen, told.object)] > 0]
    if isinstance(told, s.NeverSeen):
        return f"it shows in {len(shown)} frames" if shown else ""
    if not shown or (told.count, told.total, told.first, told.last) != (len(shown), seen.frames, shown[0], shown[-1]):
        return f"it shows in {len(shown)} of {seen.frames} frames, {shown[:1]} to {shown[-1:]}"
    return ""


def _placed(told: s.Placed, seen: Record) -> str:
    where = _at(told.when, seen.position, told, seen)
    for (axis, places), word, value in zip(PLACES.items(), (told.x, told.y, told.z), where, strict=True):
        edges = (-math.inf, *BORDERS, math.inf)
        k = places.index(word)
        inside = edges[k] <= value < edges[k + 1] and abs(value) >= 0.5
        if not (abs(value) < 0.5 if k == 3 else inside or (k == 2 and value == -0.5)):
            return f"{axis} is {value:.4f} m"
    return ""


def _at(when: str, values: np.ndarray, told: Any, seen: Record) -> np.ndarray:
    return values[0 if when == "start" else len(values) - 1, _index(seen, told.object)]


def _moving(told: s.Moving, seen: Record) -> str:
    vx, vy, vz = (float(v) for v in _at(told.when, seen.velocity, told, seen))
    speed = math.sqrt(vx * vx + vy * vy + vz * vz)
    words = [word for word, _ in PACES]
    low = (STILL, *(end for _, end in PACES))[words.index(told.pace)]
    if not low <= speed < PACES[words.index(told.pace)][1] or abs(told.speed - speed) > HALF:
        return f"its speed is {speed:.4f} m/s"
    elevation = math.degrees(math.asin(max(-1.0, min(1.0, vz / speed))))
    if told.direction in ("straight up", "straight down"):
        sign = 1 if told.direction == "straight up" else -1
        return "" if sign * elevation >= STEEP - 1e-9 else f"it rises at {elevation:.1f} degrees"
    heading, _, tilt = told.direction.partition(", ")
    low, high = {"": (-TILTED, TILTED), "rising": (TILTED, STEEP), "falling": (-STEEP, -TILTED)}[tilt]
    if not low - 1e-9 <= elevation <= high + 1e-9:
        return f"it rises at {elevation:.1f} degrees"
    angle = math.radians(45.0 * HEADINGS.index(heading))
    # Within half an octant: the velocity's part along the heading is at least cos(22.5 degrees).
    along = (vx * math.cos(angle) + vy * math.sin(angle)) / math.hypot(vx, vy)
    return "" if along >= math.cos(math.radians(22.5)) - 1e-9 else f"it heads ({vx:.3f}, {vy:.3f})"


def _still(told: s.Still, seen: Record) -> str:
    speed = math.dist((0, 0, 0), _at(told.when, seen.velocity, told, seen))
    return "" if speed < STILL else f"its speed is {speed:.4f} m/s"


def _spinning(told: s.Spinning, seen: Record) -> str:
    return _near(told.rate, math.dist((0, 0, 0), _at(told.when, seen.spin, told, seen)), "its spin")


def _fastest(told: s.Fastest, seen: Record) -> str:
    speed = np.sqrt((seen.velocity[:, _index(seen, told.object)] ** 2).sum(-1))
    times = np.arange(len(speed)) * seen.step
    there = (np.abs(times - told.time) <= HALF) & (np.abs(speed - told.speed) <= HALF)
    if there.any() and speed[there].max() >= speed.max() - 1e-12:
        return ""
    return f"it is fastest at {times[speed.argmax()]:.4f} s with {speed.max():.4f} m/s"


def _rests(told: s.Rests | s.RestsThroughout | s.NeverRests, seen: Record) -> str:
    k = _index(seen, told.object)
    fastest = np.sqrt((seen.velocity[:, k] ** 2).sum(-1)) + np.sqrt((seen.spin[:, k] ** 2).sum(-1)) * reach(
        seen.scene.objects[k]
    )
    lively = np.flatnonzero(fastest >= STILL)
    if isinstance(told, s.RestsThroughout):
        return f"it moves at {lively[0] * seen.step:.4f} s" if lively.size else ""
    if not lively.size:
        return "it is at rest throughout"
    begin = (int(lively[-1]) + 1) * seen.step
    rests = seen.duration - begin >= s.REST - 1e-9
    if isinstance(told, s.NeverRests):
        return f"it rests from {begin:.4f} s on" if rests else ""
    return _near(told.time, begin, "the begin of its rest") if rests else "it does not come to rest"


def _contact_faults(spans: s.Spans, touching: np.ndarray, seen: Record) -> str:
    """Whether ``spans``, in which nothing is rounded by more than ``HALF``, are the contacts, those within GAP as one."""
    times = [k * seen.step for k, touch in enumerate(touching) if touch]
    last = (len(touching) - 1) * seen.step
    for time in times:
        if not any(a - HALF <= time <= b + HALF for a, b in spans):
            return f"there is a contact at {time:.4f} s"
    for a, b in spans:
        inside = [time for time in times if a - HALF <= time <= b + HALF]
        if not inside:
            return f"there is no contact from {a:.2f} to {b:.2f} s"
        free = [later - earlier for earlier, later in itertools.pairwise(inside)]
        if max(free, default=0.0) > s.GAP + 1e-9:
            return f"the contact from {a:.2f} to {b:.2f} s is broken for {max(free):.4f} s"
        begin = 0.0 if inside[0] <= s.GAP + 1e-9 else inside[0]
        end = last if last - inside[-1] <= s.GAP + 1e-9 else inside[-1]
        if abs(begin - a) > HALF or abs(end - b) > HALF:
            return f"that contact lasts from {begin:.4f} to {end:.4f} s"
    for (_, end), (begin, _) in itertools.pairwise(spans):
        between = [time for time in times if time <= end + HALF], [time for time in times if time >= begin - HALF]
        if between[1][0] - between[0][-1] <= s.GAP + 1e-9:
            return f"the contacts before {end:.2f} s and after {begin:.2f} s are one"
    return ""


def _column(seen: Record, first: int, second: int) -> np.ndarray:
    return seen.touching[:, seen.pairs.index((min(first, second), max(first, second)))]


def _floor(told: s.Grounded | s.GroundedThroughout | s.Airborne, seen: Record) -> str:
    touching = _column(seen, -1, _index(seen, told.object))
    if isinstance(told, s.Airborne):
        return "it touches the floor" if touching.any() else ""
    spans = ((0.0, seen.duration),) if isinstance(told, s.GroundedThroughout) else told.spans
    return _contact_faults(spans, touching, seen)


def _begins(touching: np.ndarray, seen: Record) -> list[float]:
    """When contacts begin that were not there at the start."""
    times = [k * seen.step for k, touch in enumerate(touching) if touch]
    before = [0.0, *times]
    return [time for earlier, time in zip(before, times, strict=False) if time - earlier > s.GAP + 1e-9]


def _times(said: tuple[float, ...], true: list[float]) -> str:
    if len(said) == len(true) and all(abs(a - b) <= HALF for a, b in zip(said, true, strict=True)):
        return ""
    return "it happens at " + (", ".join(f"{time:.4f} s" for time in true) or "no time")


def _hits(told: s.HitsFloor, seen: Record) -> str:
    return _times(told.times, _begins(_column(seen, -1, _index(seen, told.object)), seen))


def _collide(told: s.Collide, seen: Record) -> str:
    if told.first == told.second:
        return "an object does not collide with itself"
    return _times(told.times, _begins(_column(seen, _index(seen, told.first), _index(seen, told.second)), seen))


def _from_start(told: s.TouchFromStart, seen: Record) -> str:
    if told.first == told.second:
        return "an object does not touch itself"
    touching = _column(seen, _index(seen, told.first), _index(seen, told.second))
    early = [k for k, touch in enumerate(touching) if touch and k * seen.step <= s.GAP + 1e-9]
    return "" if early else "they do not touch at the start"


def _nobody_else(told: s.NobodyMeets | s.NobodyElseMeets, others: Sequence[s.Statement], seen: Record) -> str:
    named = {
        frozenset((other.first, other.second)) for other in others if isinstance(other, s.Collide | s.TouchFromStart)
    }
    if isinstance(told, s.NobodyMeets):
        named = set()
    names = seen.scene.names
    for k, (first, second) in enumerate(seen.pairs):
        if first >= 0 and seen.touching[:, k].any() and frozenset((names[first], names[second])) not in named:
            return f"{names[first]} and {names[second]} touch"
    return ""


_CHECKS: dict[type, Callable[[Any, Record], str]] = {
    s.Clip: _clip,
    s.Objects: _objects,
    s.Gravity: _gravity,
    s.View: _view,
    s.Seen: _seen,
    s.NeverSeen: _seen,
    s.Placed: _placed,
    s.Moving: _moving,
    s.Still: _still,
    s.Spinning: _spinning,
    s.Fastest: _fastest,
    s.Rests: _rests,
    s.RestsThroughout: _rests,
    s.NeverRests: _rests,
    s.Grounded: _floor,
    s.GroundedThroughout: _floor,
    s.Airborne: _floor,
    s.HitsFloor: _hits,
    s.Collide: _collide,
    s.TouchFromStart: _from_start,
}
