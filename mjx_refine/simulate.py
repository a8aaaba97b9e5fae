"""A scene as an observation: what its simulation would look like."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects import batch_with_effects
from mjx_refine.errors import InputError
from mjx_refine.observation import MAX_ELEMENTS, Observation
from mjx_refine.scene import Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view.effects import draw_effects


def simulate(scene: Scene, size: tuple[int, int] = (480, 320), frames: int = 30, fps: float = 30.0) -> Observation:
    """Simulates in C MuJoCo and draws masks (object n has id n + 1) and exact flow, with the scene's effects.

    Args:
      scene: what to simulate.
      size: (width, height) [px].
      frames: number of frames, at least 2.
      fps: frames a second.

    Raises:
      InputError: an effect is wrong, the scene diverges, or the pictures would not fit in memory.
    """
    if size[0] * size[1] * frames * 2 > MAX_ELEMENTS:
        raise InputError(f"{frames} frames of {size[0]}x{size[1]}: too large; choose fewer frames or a smaller size")
    batch = batch_with_effects([scene])
    poses = MujocoSimulator(batch.shapes, fps).rollout(batch, frames)[0]
    if not np.isfinite(poses).all():
        bad = int(np.argmin(np.isfinite(poses).all((1, 2))))
        raise InputError(
            f"the simulation diverges in frame {bad}; lower stiffness or velocities, or separate the objects"
        )
    masks, flow = draw_effects(poses, batch, size, fps)
    return Observation(flow=flow.astype(np.float32), masks=masks, fps=fps, source="<simulated>")
