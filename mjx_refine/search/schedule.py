"""The stages of a landing: how much of the clip counts, and how strictly."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Stage:
    """Frames that count, scale of the robust loss [px at a picture 480 wide], most iterations."""

    frames: int
    scale: float
    iterations: int


HORIZONS = (0.1, 0.17, 0.24, 0.32, 0.41, 0.5, 0.6, 0.72, 0.86, 1.0)
"""Parts of the clip, one after the other; small steps at first, while there is little to go by."""


HEATS = (0.1, 0.41)
"""Parts of the clip at which samples that may land are compared."""


def stages(length: int) -> list[Stage]:
    """The horizon from the first frame to the whole clip, the loss from forgiving to strict."""
    horizons = sorted({1, *[min(length, max(2, round(length * part))) for part in HORIZONS]})
    result = [Stage(h, 12.0 if h < length else 6.0, 3 if h < length else 8) for h in horizons]
    return [*result, Stage(length, 2.0, 8)]
