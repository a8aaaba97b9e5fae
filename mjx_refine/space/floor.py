"""Scenes on a tilted floor as they would stand on a level one, and back: heights and tilts are measured from the floor."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_refine.batch import scene_from_batch
from mjx_refine.effects import acting
from mjx_refine.scene import Scene


def levelled(scene: Scene) -> Scene:
    """The scene with its objects turned as the floor would be to become level; gravity, camera and effects stay.

    Raises:
      InputError: an effect is wrong.
    """
    batch = acting.batch_with_effects([scene])
    tilt = acting.floor_rotation(batch)
    if tilt is None:
        return scene
    turned = acting.turned_state(batch, np.swapaxes(tilt, -1, -2))
    return scene_from_batch(dataclasses.replace(turned, gravity=batch.gravity), 0, scene)


def tilted(scene: Scene) -> Scene:
    """The inverse of ``levelled``."""
    batch = acting.batch_with_effects([scene])
    return scene if acting.floor_rotation(batch) is None else scene_from_batch(acting.on_the_floor(batch), 0, scene)
