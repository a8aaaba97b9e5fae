"""Objects that go on from states of their own along the way: a rollout in segments (multiple shooting; Bock and Plitt 1984)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.batch import SceneBatch


class Restarts:
    """Of one rollout.

    Args:
      batch: with its restarts, in the axes of the simulation.
      objects: how many objects there are.
      frames: of the rollout; what restarts later does not.
    """

    def __init__(self, batch: SceneBatch, objects: int, frames: int):
        self._batch, self._objects = batch, objects
        self.arrived: Float[np.ndarray, "batch restarts 13"] = np.full((len(batch), len(batch.restarts), 13), np.nan)
        """States in which paths end where others begin; NaN where the rollout does not get there."""
        self.frames = sorted({r.frame for r in batch.restarts if 0 < r.frame < frames})

    def after(self, frame: int, last: int) -> int:
        """The first frame after ``frame`` in which something restarts, or ``last``."""
        return next((f for f in self.frames if f > frame), last)

    def begin(self, frame: int, state: Float[np.ndarray, "batch state"]) -> bool:
        """Writes into ``state`` (time, positions, velocities) what restarts in a frame, and keeps how it arrived; whether
        anything does."""
        if frame not in self.frames:
            return False
        for k, one in enumerate(self._batch.restarts):
            if one.frame == frame:
                place = 1 + 7 * one.target
                speed = 1 + 7 * self._objects + 6 * one.target
                columns = np.r_[place : place + 7, speed : speed + 6]
                self.arrived[:, k] = state[:, columns]
                state[:, columns] = one.state
        return True
