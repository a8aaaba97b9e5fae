"""Pushes apart objects that start inside one another or in the floor, least movement first."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_refine.batch import SceneBatch, batch_from_scenes, scene_from_batch
from mjx_refine.scene import Scene
from mjx_refine.sim.c import MujocoSimulator

TOLERANCE = 1e-4
"""Overlap that is left [m]: far below what contacts at rest have."""


def separate(scene: Scene, simulator: MujocoSimulator, sweeps: int = 200) -> tuple[Scene, float]:
    """Moves objects until none overlaps another or the floor by more than 0.1 mm.

    Each sweep asks MuJoCo for the contacts of the first frame and resolves the shallowest pair first, moving both
    objects along the contact normal by half the depth each (the floor does not move), so that a small overlap is not
    paid for by a large one's correction.

    Returns:
      the separated scene and the longest way that an object was moved [m] (0 where nothing overlapped).
    """
    batch = batch_from_scenes([scene])
    position = batch.position.copy()
    batch = dataclasses.replace(batch, position=position)
    start = position.copy()
    for sweep in range(sweeps):
        # Later sweeps push a little further, so that chains of objects do not converge for ever.
        if not _sweep(batch, position, simulator, push=1.0 if sweep < sweeps // 2 else 1.2):
            break
    moved = float(np.linalg.norm(position - start, axis=-1).max())
    if moved == 0.0:
        return scene, 0.0
    return scene_from_batch(batch, 0, scene), moved


def _sweep(batch: SceneBatch, position: np.ndarray, simulator: MujocoSimulator, push: float) -> bool:
    deepest: dict[tuple[int, int], tuple[float, np.ndarray]] = {}
    for first, second, distance, normal in simulator.contacts(batch, 0):
        if -distance > deepest.get((first, second), (TOLERANCE, normal))[0]:
            deepest[first, second] = (-distance, normal)
    for (first, second), (depth, normal) in sorted(deepest.items(), key=lambda item: item[1][0]):
        way = normal * (depth * push + TOLERANCE / 2)
        if first < 0:
            position[0, second] += way
        else:
            position[0, first] -= way / 2
            position[0, second] += way / 2
    return bool(deepest)
