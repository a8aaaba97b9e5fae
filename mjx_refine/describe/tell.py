"""From a recorded simulation to the statements that a description makes, in its order."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from mjx_refine.batch import geom_size
from mjx_refine.describe.classes import STILL, direction_word, pace_word, place_word
from mjx_refine.describe.record import Record
from mjx_refine.describe.statements import (
    GAP,
    REST,
    Airborne,
    Clip,
    Collide,
    Fastest,
    Gravity,
    Grounded,
    GroundedThroughout,
    HitsFloor,
    Moving,
    NeverRests,
    NeverSeen,
    NobodyElseMeets,
    NobodyMeets,
    Objects,
    Placed,
    Rests,
    RestsThroughout,
    Seen,
    Spans,
    Spinning,
    Statement,
    Still,
    TouchFromStart,
    View,
    When,
)
from mjx_refine.scene import Body


def tell(record: Record) -> list[list[Statement]]:
    """Everything worth telling: the set-up, a paragraph an object, then who meets whom."""
    objects = [_about_object(record, index) for index in range(len(record.scene.objects))]
    return [_setting(record), *objects, *([_meetings(record)] if len(objects) > 1 else [])]


def reach(body: Body) -> float:
    """Distance of a body's farthest point from its centre [m]."""
    size = geom_size(body)
    return size[0] if body.shape == "sphere" else float(np.linalg.norm(size))


def _setting(record: Record) -> list[Statement]:
    scene, (width, height) = record.scene, record.size
    return [
        Clip(record.frames, _short(record.fps), width, height),
        Objects(tuple((body.name, body.shape) for body in scene.objects)),
        Gravity(*(_round(v) for v in scene.gravity)),
        View(_round(scene.camera.position[2]), _round(scene.camera.orientation), _round(scene.camera.fovy)),
    ]


def _round(value: float) -> float:
    return round(float(value), 2) + 0.0


def _short(value: float) -> float:
    return float(f"{value:g}")


def _about_object(record: Record, index: int) -> list[Statement]:
    name = record.scene.objects[index].name
    told = [_seen(record, index, name), *_state(record, index, name, "start")]
    speed = np.linalg.norm(record.velocity[:, index], axis=-1)
    if speed.max() >= STILL:
        top = int(speed.argmax())
        told.append(Fastest(name, _round(speed[top]), _round(top * record.step)))
    told += _floor(record, index, name)
    told.append(_rest(record, index, name))
    return told + _state(record, index, name, "end")


def _seen(record: Record, index: int, name: str) -> Statement:
    shown = np.flatnonzero(record.pixels[:, index])
    if not shown.size:
        return NeverSeen(name)
    return Seen(name, len(shown), record.frames, int(shown[0]), int(shown[-1]))


def _state(record: Record, index: int, name: str, when: When) -> list[Statement]:
    at = 0 if when == "start" else -1
    x, y, z = (float(v) for v in record.position[at, index])
    told: list[Statement] = [Placed(name, when, place_word("x", x), place_word("y", y), place_word("z", z))]
    velocity = record.velocity[at, index]
    speed, rate = (float(np.linalg.norm(v)) for v in (velocity, record.spin[at, index]))
    if speed < STILL:
        told.append(Still(name, when))
    else:
        told.append(Moving(name, when, pace_word(speed), _round(speed), direction_word(velocity)))
    return told if rate < STILL else [*told, Spinning(name, when, _round(rate))]


def _rest(record: Record, index: int, name: str) -> Statement:
    speed, rate = (np.linalg.norm(v[:, index], axis=-1) for v in (record.velocity, record.spin))
    calm = speed + rate * reach(record.scene.objects[index]) < STILL
    # How many states at the end are calm without a break.
    lasting = int(np.logical_and.accumulate(calm[::-1]).sum())
    if lasting == len(calm):
        return RestsThroughout(name)
    if (lasting - 1) * record.step < REST:
        return NeverRests(name)
    return Rests(name, _round((len(calm) - lasting) * record.step))


def contact_spans(touching: Bool[np.ndarray, "states"], step: float) -> Spans:
    """(begin, end) [s] of every contact, those within ``GAP`` of one another merged and drawn to the clip's ends."""
    times = np.flatnonzero(touching) * step
    if not times.size:
        return ()
    breaks = np.flatnonzero(np.diff(times) > GAP + 1e-9)
    begins, ends = times[np.r_[0, breaks + 1]], times[np.r_[breaks, len(times) - 1]]
    last = (len(touching) - 1) * step
    begins[0] = 0.0 if begins[0] <= GAP + 1e-9 else begins[0]
    ends[-1] = last if last - ends[-1] <= GAP + 1e-9 else ends[-1]
    return tuple(zip(begins.tolist(), ends.tolist(), strict=True))


def _floor(record: Record, index: int, name: str) -> list[Statement]:
    spans = contact_spans(record.touching[:, record.pairs.index((-1, index))], record.step)
    if not spans:
        return [Airborne(name)]
    if len(spans) == 1 and spans[0] == (0.0, record.duration):
        return [GroundedThroughout(name)]
    told: list[Statement] = [Grounded(name, tuple((_round(a), _round(b)) for a, b in spans))]
    hits = tuple(_round(begin) for begin, _ in spans if begin > 0)
    return [*told, HitsFloor(name, hits)] if hits else told


def _meetings(record: Record) -> list[Statement]:
    told: list[Statement] = []
    names = record.scene.names
    for k, (first, second) in enumerate(record.pairs):
        spans = contact_spans(record.touching[:, k], record.step) if first >= 0 else ()
        if spans and spans[0][0] == 0.0:
            told.append(TouchFromStart(names[first], names[second]))
        times = tuple(_round(begin) for begin, _ in spans if begin > 0)
        if times:
            told.append(Collide(names[first], names[second], times))
    return [*told, NobodyElseMeets()] if told else [NobodyMeets()]
