"""Scenes with effects, entry by entry, for tests of what effects do."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_refine.effects import batch_with_effects
from mjx_refine.scene import Body, Camera, Effect, Scene
from mjx_refine.sim.c import MujocoSimulator

FPS = 30.0
STEP = 1 / (8 * FPS)
GRAVITY = 9.81
CAMERA = Camera((0.0, -3.0, 2.0), 60.0, 45.0)
BALL = Body("sphere", "ball", (0.2,), (0.0, 0.0, 50.0), mass=0.7)


def effect(name: str, target: str | None = None, **parameters) -> Effect:
    return Effect(
        name, target, tuple((k, tuple(v) if isinstance(v, list) else float(v)) for k, v in parameters.items())
    )


def rolled_out(
    *effects: Effect, frames: int = 31, gravity: float = 0.0, body: Body = BALL, others=(), **state
) -> np.ndarray:
    """Poses (frames, objects, 7)."""
    scene = Scene((dataclasses.replace(body, **state), *others), CAMERA, (0.0, 0.0, -gravity), effects)
    return MujocoSimulator(scene.shapes, FPS, 1).rollout(batch_with_effects([scene]), frames)[0]
