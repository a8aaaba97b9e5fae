"""A scene, with its effects, as it would have been filmed beside the clip."""

from __future__ import annotations

import numpy as np
from mjx_fitness import score_pictures

from mjx_refine.effects import batch_with_effects, kind_of
from mjx_refine.effects.acting import apparent
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.search.result import Replay
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view.picture import draw
from mjx_refine.view.tiles import foreground


def replay(scene: Scene, observation: Observation, matching: tuple[int, ...]) -> Replay:
    """The scene in C MuJoCo, with its effects, drawn at the clip's size and scored against it.

    Args:
      scene: what to simulate.
      observation: the clip.
      matching: for each object its mask's id, or ``UNMATCHED``.

    Raises:
      InputError: an effect of the scene is unknown or has a wrong parameter.
    """
    batch = batch_with_effects([scene])
    poses = MujocoSimulator(batch.shapes, observation.fps, 1).rollout(batch, observation.length)
    poses = apparent(poses, batch, observation.fps)[0]
    masks, flow = draw(poses, batch, observation.size)
    scores = score_pictures(masks, flow.astype(np.float32), foreground(observation), observation.flow, matching)
    return Replay(scene, poses, masks, flow, scores)


def not_drawn(scene: Scene) -> tuple[str, ...]:
    """Names of the scene's effects that the pictures of ``replay`` leave out."""
    return tuple(effect.effect for effect in scene.effects if kind_of(effect.effect).drawn)
