"""The sentences: several templates a kind of statement, used both to write and to read.

``{field:slot}`` stands for a field of the statement's class, written and read by ``SLOTS[slot]``. ``{it}`` is the field
``object``: its name, or a pronoun where the last sentence was about the same object.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np

from mjx_refine.describe import statements as s
from mjx_refine.describe.slots import NAME, SLOTS, name_text, read_name

_FIELD = re.compile(r"\{(\w+)(?::(\w+))?\}")

PHRASES: dict[type, tuple[str, ...]] = {
    s.Clip: (
        "The clip has {frames:integer} frames at {fps:rate} fps, drawn at {width:integer}x{height:integer} pixels",
        "There are {frames:integer} frames of {width:integer}x{height:integer} pixels at {fps:rate} fps",
    ),
    s.Objects: (
        "There are {objects:counted}",
        "The scene holds {objects:counted}",
        "In the scene are {objects:objects}",
    ),
    s.Gravity: (
        "Gravity is ({x:number}, {y:number}, {z:number}) m/s^2",
        "Everything is pulled by a gravity of ({x:number}, {y:number}, {z:number}) m/s^2",
    ),
    s.View: (
        "The camera is at height {height:number} m, turned {pitch:number} degrees from straight down, "
        "with a vertical field of view of {fovy:number} degrees",
        "A camera {height:number} m high, turned {pitch:number} degrees from straight down, sees "
        "{fovy:number} degrees from top to bottom",
    ),
    s.Seen: (
        "{it} is in view in {count:integer} of {total:integer} frames, from frame {first:integer} to frame {last:integer}",
        "{it} shows from frame {first:integer} to frame {last:integer}, in {count:integer} of {total:integer} frames",
        "{count:integer} of {total:integer} frames show {it}, the first is frame {first:integer}, "
        "the last frame {last:integer}",
    ),
    s.NeverSeen: ("{it} is never in view", "No frame shows {it}"),
    s.Placed: (
        "{When:When} {it} is {x:x}, {y:y} and {z:z}",
        "{it} is {x:x}, {y:y} and {z:z} {when:when}",
        "{When:When} {it} is to be found {x:x}, {y:y}, {z:z}",
    ),
    s.Moving: (
        "{When:When} {it} moves {pace:pace} {direction:direction} at {speed:number} m/s",
        "{it} goes {direction:direction} {pace:pace}, at {speed:number} m/s, {when:when}",
        "{When:When} {it} travels at {speed:number} m/s, {pace:pace} {direction:direction}",
    ),
    s.Still: (
        "{When:When} {it} does not move from its place",
        "{it} stands still {when:when}",
        "{When:When} {it} has no speed",
    ),
    s.Spinning: (
        "{When:When} {it} spins at {rate:number} rad/s",
        "{it} turns at {rate:number} rad/s {when:when}",
    ),
    s.Fastest: (
        "{it} is fastest at {time:number} s with {speed:number} m/s",
        "{it} has its top speed, {speed:number} m/s, at {time:number} s",
        "At {time:number} s {it} reaches its top speed, {speed:number} m/s",
    ),
    s.Rests: (
        "{it} comes to rest at {time:number} s",
        "From {time:number} s on {it} is at rest",
        "At {time:number} s {it} comes to a stop",
    ),
    s.RestsThroughout: ("{it} is at rest throughout", "{it} never moves"),
    s.NeverRests: ("{it} does not come to rest", "The clip ends before {it} comes to rest"),
    s.Grounded: (
        "{it} is on the floor {spans:spans}",
        "{it} touches the floor {spans:spans}",
        "The floor carries {it} {spans:spans}",
    ),
    s.GroundedThroughout: ("{it} stays on the floor all the time", "{it} never leaves the floor"),
    s.Airborne: ("{it} never touches the floor", "{it} is in the air all the time"),
    s.HitsFloor: (
        "{it} hits the floor at {times:times}",
        "{it} comes down on the floor at {times:times}",
        "At {times:times} {it} strikes the floor",
    ),
    s.Collide: (
        "{first:name} and {second:name} collide at {times:times}",
        "{first:name} hits {second:name} at {times:times}",
        "At {times:times} {first:name} and {second:name} run into each other",
    ),
    s.TouchFromStart: (
        "{first:name} and {second:name} touch from the start",
        "The clip begins with {first:name} touching {second:name}",
    ),
    s.NobodyMeets: ("No two objects touch each other", "The objects never meet"),
    s.NobodyElseMeets: ("No other objects touch each other", "Apart from that, no two objects meet"),
}


@dataclasses.dataclass(frozen=True)
class Template:
    """One way to say a kind of statement.

    Attributes:
      kind: the statement's class.
      text: with its slots.
      pattern: what it matches: a group for every field, in the order of ``fields``.
      fields: (field, slot); the slot of ``{it}`` is ``it``.
    """

    kind: type
    text: str
    pattern: re.Pattern[str]
    fields: tuple[tuple[str, str], ...]

    def write(self, statement: Any, rng: np.random.Generator, pronoun: bool) -> str:
        """The sentence, without its full stop."""

        def one(match: re.Match[str]) -> str:
            if match[1] == "it":
                return ("It" if match.start() == 0 else "it") if pronoun else name_text(statement.object)
            return SLOTS[match[2]].write(getattr(statement, match[1].lower()), rng)

        return _FIELD.sub(one, self.text)

    def read(self, sentence: str, subject: str | None) -> Any | None:
        """The statement that ``sentence`` makes, or None where it is not of this form.

        Raises:
          ValueError: it contradicts itself, or says ``it`` of nothing.
        """
        match = self.pattern.fullmatch(sentence)
        if match is None:
            return None
        values: dict[str, Any] = {}
        for (field, slot), text in zip(self.fields, match.groups(), strict=True):
            if slot == "it":
                values["object"] = subject if text in ("it", "It") else read_name(text)
                if values["object"] is None:
                    raise ValueError("no object was named before `it`")
            else:
                values[field.lower()] = SLOTS[slot].read(text)
        return self.kind(**values)


def _template(kind: type, text: str) -> Template:
    pattern, at, fields = "", 0, []
    for match in _FIELD.finditer(text):
        inside = rf"{NAME}|{'It' if match.start() == 0 else 'it'}" if match[1] == "it" else SLOTS[match[2]].pattern
        pattern += re.escape(text[at : match.start()]) + f"({inside})"
        fields.append((match[1], match[2] or "it"))
        at = match.end()
    return Template(kind, text, re.compile(pattern + re.escape(text[at:])), tuple(fields))


TEMPLATES: dict[type, tuple[Template, ...]] = {
    kind: tuple(_template(kind, text) for text in texts) for kind, texts in PHRASES.items()
}
