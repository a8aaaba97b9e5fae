"""What a description can say: one frozen class a kind of sentence, with the numbers as they are written."""

from __future__ import annotations

import dataclasses
from typing import Literal

When = Literal["start", "end"]
Spans = tuple[tuple[float, float], ...]

GAP = 0.05
"""Contacts no further apart than this are one contact [s]; nor does one that begins so soon begin after the start, or one
that ends so late end before the clip's end."""

REST = 0.1
"""Rest lasts at least so long, until the clip's end [s]."""


@dataclasses.dataclass(frozen=True)
class Clip:
    """How many frames of which rate and size [1/s, px]."""

    frames: int
    fps: float
    width: int
    height: int


@dataclasses.dataclass(frozen=True)
class Objects:
    """All objects: (name, shape)."""

    objects: tuple[tuple[str, str], ...]


@dataclasses.dataclass(frozen=True)
class Gravity:
    """Gravity [m/s^2]."""

    x: float
    y: float
    z: float


@dataclasses.dataclass(frozen=True)
class View:
    """The camera's height [m], pitch from straight down [degree] and vertical field of view [degree]."""

    height: float
    pitch: float
    fovy: float


@dataclasses.dataclass(frozen=True)
class Seen:
    """An object shows in ``count`` of ``total`` frames, first and last in these (from 0)."""

    object: str
    count: int
    total: int
    first: int
    last: int


@dataclasses.dataclass(frozen=True)
class NeverSeen:
    """No frame shows an object."""

    object: str


@dataclasses.dataclass(frozen=True)
class Placed:
    """Classes of a centre's coordinates."""

    object: str
    when: When
    x: str
    y: str
    z: str


@dataclasses.dataclass(frozen=True)
class Moving:
    """Pace, speed [m/s] and direction of a centre."""

    object: str
    when: When
    pace: str
    speed: float
    direction: str


@dataclasses.dataclass(frozen=True)
class Still:
    """A centre does not move (slower than ``STILL``)."""

    object: str
    when: When


@dataclasses.dataclass(frozen=True)
class Spinning:
    """Angular speed [rad/s]."""

    object: str
    when: When
    rate: float


@dataclasses.dataclass(frozen=True)
class Fastest:
    """The largest speed of a centre [m/s] and when it has it [s]."""

    object: str
    speed: float
    time: float


@dataclasses.dataclass(frozen=True)
class Rests:
    """From ``time`` [s] to the end no point of an object is faster than ``STILL``."""

    object: str
    time: float


@dataclasses.dataclass(frozen=True)
class RestsThroughout:
    """No point of an object is ever faster than ``STILL``."""

    object: str


@dataclasses.dataclass(frozen=True)
class NeverRests:
    """An object does not come to rest for ``REST`` seconds before the end."""

    object: str


@dataclasses.dataclass(frozen=True)
class Grounded:
    """An object touches the floor in these spans [s] and in no other."""

    object: str
    spans: Spans


@dataclasses.dataclass(frozen=True)
class GroundedThroughout:
    """An object touches the floor all the time."""

    object: str


@dataclasses.dataclass(frozen=True)
class Airborne:
    """An object never touches the floor."""

    object: str


@dataclasses.dataclass(frozen=True)
class HitsFloor:
    """All times at which an object comes down on the floor [s]."""

    object: str
    times: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Collide:
    """All times at which two objects begin to touch [s]."""

    first: str
    second: str
    times: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class TouchFromStart:
    """Two objects touch as the clip begins."""

    first: str
    second: str


@dataclasses.dataclass(frozen=True)
class NobodyMeets:
    """No two objects ever touch."""


@dataclasses.dataclass(frozen=True)
class NobodyElseMeets:
    """No two objects touch but those of which the description says so."""


Statement = (
    Clip | Objects | Gravity | View | Seen | NeverSeen | Placed | Moving | Still | Spinning | Fastest | Rests
    | RestsThroughout | NeverRests | Grounded | GroundedThroughout | Airborne | HitsFloor | Collide | TouchFromStart
    | NobodyMeets | NobodyElseMeets
)  # fmt: skip
