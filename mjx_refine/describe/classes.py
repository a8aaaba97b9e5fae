"""Words for places, speeds and directions, and the borders between them."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from jaxtyping import Float

Axis = Literal["x", "y", "z"]

BORDERS = (-2.0, -1.25, -0.5, 0.5, 1.25, 2.0)
"""Between the seven classes of a coordinate [m]: the outermost and the middle ones are the paper's, the inner ones lie
halfway between. A border belongs to the class above it, but the lower border of the middle class to the one below."""

PLACES: dict[Axis, tuple[str, ...]] = {
    "x": (
        "far left", "moderately left", "slightly left", "near center",
        "slightly right", "moderately right", "far right",
    ),
    "y": (
        "far to the front", "moderately to the front", "slightly to the front", "near the middle",
        "slightly to the back", "moderately to the back", "far to the back",
    ),
    "z": (
        "far below the floor", "moderately below the floor", "slightly below the floor", "near the floor",
        "slightly above the floor", "moderately above the floor", "far above the floor",
    ),
}  # fmt: skip
"""From the lowest coordinate to the highest: x to the right, y away from the viewer (to the back), z up."""

STILL = 0.05
"""Below this speed nothing moves to speak of [m/s]; of spins [rad/s]."""

PACES = (("very slowly", 0.3), ("slowly", 1.0), ("at a moderate pace", 2.5), ("fast", 5.0), ("very fast", math.inf))
"""Words for speeds, each with the speed [m/s] that is the next word's first; slower than ``STILL`` is no motion."""

HEADINGS = (
    "to the right", "to the right and back", "to the back", "to the left and back",
    "to the left", "to the left and front", "to the front", "to the right and front",
)  # fmt: skip
"""Octants of the horizontal plane, each 45 degrees wide, counter-clockwise from +x as seen from above."""

TILTED, STEEP = 15.0, 60.0
"""Elevations [degree] from which a velocity is called rising or falling, and straight up or down."""

DIRECTIONS = ("straight up", "straight down", *(f"{h}{t}" for h in HEADINGS for t in ("", ", rising", ", falling")))


def place_word(axis: Axis, value: float) -> str:
    """The class of a coordinate [m]."""
    index = sum(value >= border for border in BORDERS)
    # |x| < 0.5 is near the centre: -0.5 itself is not.
    return PLACES[axis][2 if value == BORDERS[2] else index]


def pace_word(speed: float) -> str:
    """The word for a speed [m/s] of at least ``STILL``."""
    return next(word for word, end in PACES if speed < end)


def direction_word(velocity: Float[np.ndarray, "3"]) -> str:
    """Where a velocity that is not zero points, of ``DIRECTIONS``."""
    x, y, z = (float(v) for v in velocity)
    elevation = math.degrees(math.atan2(z, math.hypot(x, y)))
    if abs(elevation) >= STEEP:
        return "straight up" if elevation > 0 else "straight down"
    octant = round(math.degrees(math.atan2(y, x)) / 45.0) % 8
    tilt = "" if abs(elevation) < TILTED else ", rising" if elevation > 0 else ", falling"
    return HEADINGS[octant] + tilt
