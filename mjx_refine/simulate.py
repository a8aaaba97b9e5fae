"""A scene as an observation: what its simulation would look like."""

from __future__ import annotations

import numpy as np

from mjx_refine.batch import batch_from_scenes
from mjx_refine.errors import InputError
from mjx_refine.observation import MAX_ELEMENTS, Observation
from mjx_refine.scene import Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view.picture import draw


def simulate(scene: Scene, size: tuple[int, int] = (480, 320), frames: int = 30, fps: float = 30.0) -> Observation:
    """Simulates in C MuJoCo and draws masks (object n has id n + 1) and exact flow.

    Args:
      scene: what to simulate.
      size: (width, height) [px].
      frames: number of frames, at least 2.
      fps: frames a second.

    Raises:
      InputError: the scene has effects, it diverges, or the pictures would not fit in memory.
    """
    if scene.effects:
        raise InputError(
            f"entry effect ({scene.effects[0].effect}): this version simulates the base model alone; remove the entry"
        )
    if size[0] * size[1] * frames * 2 > MAX_ELEMENTS:
        raise InputError(f"{frames} frames of {size[0]}x{size[1]}: too large; choose fewer frames or a smaller size")
    batch = batch_from_scenes([scene])
    poses = MujocoSimulator(batch.shapes, fps).rollout(batch, frames)[0]
    if not np.isfinite(poses).all():
        bad = int(np.argmin(np.isfinite(poses).all((1, 2))))
        raise InputError(
            f"the simulation diverges in frame {bad}; lower stiffness or velocities, or separate the objects"
        )
    masks, flow = draw(poses, batch, size)
    return Observation(flow=flow.astype(np.float32), masks=masks, fps=fps, source="<simulated>")
