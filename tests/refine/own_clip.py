"""A clip that our own simulator made and drew, for tests that fit it."""

from __future__ import annotations

import numpy as np

from mjx_refine.batch import SceneBatch, batch_from_scenes
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Camera, Scene
from mjx_refine.search.features import outlines
from mjx_refine.search.landing import LeastSquares
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space
from mjx_refine.view.picture import draw
from mjx_refine.view.tiles import TileScorer

SIZE = (320, 214)
CAMERA = Camera((0.0, -3.0, 1.6), 65.0, 45.0)
FLIGHT = Scene(
    (Body("sphere", "ball", (0.2,), (-0.8, 0.3, 0.9), linear_velocity=(2.0, 0.4, 2.2)),), CAMERA, (0.0, 0.0, -9.81)
)
SLIDE = Scene(
    (
        Body("box", "crate", (0.3, 0.2, 0.15), (-0.6, 0.1, 0.15), (0.966, 0.0, 0.0, 0.2588), (2.2, -0.2, 0.0),
             friction=(0.3, 0.01), damping=-30.0),
    ),
    CAMERA,
    (0.0, 0.0, -9.81),
)  # fmt: skip
SCENES = {"flight": FLIGHT, "slide": SLIDE}


class OwnClip:
    """A clip of a scene with one object, what is measured of it, and a count of rollouts in units of the clip."""

    def __init__(self, scene: Scene, frames: int):
        self.scene, self.frames = scene, frames
        self.simulator = MujocoSimulator(scene.shapes, 30.0, 1)
        batch = batch_from_scenes([scene])
        self.masks, self.flow = draw(self.simulator.rollout(batch, frames)[0], batch, SIZE)
        self.seen = outlines(self.masks)
        self.scorer = TileScorer(scene.shapes, Observation(self.flow, self.masks, 30.0), (1,))
        self.rollouts = 0.0

    def rollout(self, batch: SceneBatch, frames: int) -> np.ndarray:
        self.rollouts += len(batch) * frames / self.frames
        return self.simulator.rollout(batch, frames)

    def squares(self, start: Scene, columns: tuple[int, ...] = (0,), **options) -> LeastSquares:
        return LeastSquares(Space.around(start), self.rollout, self.seen, columns, SIZE, **options)

    def iou(self, scene: Scene) -> float:
        batch = batch_from_scenes([scene])
        return float(self.scorer(self.simulator.rollout(batch, self.frames), batch).iou[0])


def perturbed(scene: Scene, seed: int, scale: float = 0.7) -> Scene:
    """A scene some prior widths away."""
    space = Space.around(scene)
    step = scale * space.sigma * np.random.default_rng(seed).normal(size=space.dimension)
    return space.scene_at(np.clip(space.start + step, 0, 1))
