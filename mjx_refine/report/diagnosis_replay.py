"""A scene, with its effects, as it would have been filmed beside the clip."""

from __future__ import annotations

import numpy as np
from mjx_fitness import score_pictures

from mjx_refine.effects import batch_with_effects
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.search.result import Replay
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view.effects import draw_effects
from mjx_refine.view.tiles import foreground

_AWAY = (0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 0.0)
"""Where an object is drawn whose simulation diverged: below the floor."""


def replay(scene: Scene, observation: Observation, matching: tuple[int, ...]) -> Replay:
    """The scene in C MuJoCo, drawn with its effects at the clip's size and scored against it.

    Args:
      scene: what to simulate; poses are NaN, and nothing is drawn, from where it diverges.
      observation: the clip; without masks its moving region is what was seen.
      matching: for each object its mask's id, or ``UNMATCHED``.

    Raises:
      InputError: an effect of the scene is unknown or has a wrong parameter.
    """
    batch = batch_with_effects([scene])
    poses = MujocoSimulator(batch.shapes, observation.fps, 1).rollout(batch, observation.length)[0]
    drawn = np.where(np.isfinite(poses), poses, _AWAY)
    masks, flow = draw_effects(drawn, batch, observation.size, observation.fps)
    flow = flow.astype(np.float32)
    moving = masks
    if observation.masks is None:
        # Only what moves can be compared with the moving region.
        fast = (flow.astype(np.float64) ** 2).sum(-1) > 0.25
        moving = masks * np.concatenate([fast, np.zeros_like(fast[:1])])
    scores = score_pictures(moving, flow, foreground(observation), observation.flow, matching)
    return Replay(scene, poses, masks, flow, scores)
