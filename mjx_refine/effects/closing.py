"""For how long nothing can have come so near that it matters."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.effects.kind import Motion

GLANCE = 0.1
"""Longest time for which nobody looks at where bodies are [s]."""

GAIN = 20.0
"""Acceleration that a body may have meanwhile [m/s^2]: twice that of gravity."""


def glance(gap: Float[np.ndarray, "*batch"], closing: Float[np.ndarray, "*batch"] | float) -> float:
    """For how long nothing that closes in at speeds ``closing`` [m/s] can cover ``gap`` [m], surely [s]."""
    gap = np.maximum(gap, 0.0)
    time = (np.sqrt(closing * closing + 2 * GAIN * gap) - closing) / GAIN
    # What has diverged goes nowhere.
    return float(np.min(time, initial=GLANCE, where=np.isfinite(time)))


def rim_speed(motion: Motion) -> Float[np.ndarray, "batch objects"]:
    """How fast spin moves what lies farthest from a body's centre, at most [m/s]."""
    return np.linalg.norm(motion.turning, axis=-1) * np.linalg.norm(motion.batch.size, axis=-1)


def swing(motion: Motion, target: int) -> Float[np.ndarray, "batch"]:
    """How fast spin moves a body's outline at most [m/s]: a ball's and a rolling cylinder's stays where it is."""
    shape = motion.batch.shapes[target]
    if shape == "sphere":
        return np.zeros(len(motion.turning))
    turning = motion.turning[:, target, : 2 if shape == "cylinder" else 3]
    return np.linalg.norm(turning, axis=-1) * np.linalg.norm(motion.batch.size[:, target], axis=-1)
