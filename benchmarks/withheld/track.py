"""Motion in fine steps, so that it can be asked for at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.clips import rotation

RATE = 480.0  # steps a second; the scene format's own simulation takes 240


@dataclass(frozen=True)
class Track:
    """Poses of the geometric centres in every step.

    Fields:
      position: (steps, objects, 3) m. quaternion: (steps, objects, 4) w x y z, body to world, signs made continuous.
      scale: size of what is drawn against the primitive, (steps, objects).
      speed: of each object's centre of mass, (steps, objects) m/s.
      touched: which objects met, (objects, objects). gap: least distance at the start, m.
      acting: per effect (in order) and object: whether it acted in the step, (effects, steps, objects).
      wall: (angle degrees, distance m) of the hidden face that was hit, or None.
    """

    position: Float[np.ndarray, "steps objects 3"]
    quaternion: Float[np.ndarray, "steps objects 4"]
    scale: Float[np.ndarray, "steps objects"]
    speed: Float[np.ndarray, "steps objects"]
    touched: Bool[np.ndarray, "objects objects"]
    gap: float
    acting: Bool[np.ndarray, "effects steps objects"]
    wall: tuple[float, float] | None

    def at(
        self, times: Float[np.ndarray, "*n"], index: int
    ) -> tuple[Float[np.ndarray, "*n 3"], Float[np.ndarray, "*n 3 3"], Float[np.ndarray, "*n"]]:
        """Position, rotation and scale of an object at times [s]; before the first step it moves on straight."""
        place = np.asarray(times, float) * RATE
        low = np.clip(np.floor(place).astype(int), 0, len(self.position) - 2)
        share = (place - low)[..., None]
        p, q = self.position[:, index], self.quaternion[:, index]
        turn = rotation.matrix(q[low] + share * (q[low + 1] - q[low]))
        size = self.scale[low, index] + share[..., 0] * (self.scale[low + 1, index] - self.scale[low, index])
        return p[low] + share * (p[low + 1] - p[low]), turn, size


def continuous(quaternion: Float[np.ndarray, "steps objects 4"]) -> Float[np.ndarray, "steps objects 4"]:
    """The same rotations with signs that do not jump from step to step."""
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(-1) < 0, -1.0, 1.0)
    signs = np.concatenate([np.ones((1, quaternion.shape[1])), np.cumprod(flips, 0)])
    return quaternion * signs[..., None]
