"""Poses that our own simulator made, with noise, for tests that diagnose them."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_refine import rotations
from mjx_refine.diagnosis import Poses, make_poses
from mjx_refine.effects import batch_with_effects
from mjx_refine.scene import Body, Camera, Effect, Scene
from mjx_refine.sim.c import MujocoSimulator

CAMERA = Camera((0.0, -3.0, 1.6), 65.0, 45.0)
BALL = Body(
    "sphere",
    "ball",
    (0.1,),
    (-0.9, 0.3, 1.0),
    linear_velocity=(3.0, 0.3, 2.5),
    angular_velocity=(1.0, 4.0, 2.0),
    mass=0.2,
)
THROW = Scene((BALL,), CAMERA, (0.0, 0.0, -9.81))
GIVEN = Scene((dataclasses.replace(BALL, position=(0.0, 0.0, 1.0), linear_velocity=(0.0, 0.0, 0.0)),), CAMERA)
SIGMA = 1e-3, float(np.deg2rad(0.5))
"""Noise of a coordinate [m] and of a rotation about one axis [rad]."""


def exact(scene: Scene, rate: float, count: int) -> np.ndarray:
    """Simulated poses, (times, objects, 7)."""
    return MujocoSimulator(scene.shapes, rate, 1).rollout(batch_with_effects([scene]), count)[0]


def recorded(scene: Scene, rate: float = 74.0, span: float = 0.8, seed: int = 0, **changes) -> Poses:
    """Poses of a scene's objects as a tracker with noise would give them; ``changes``: of ``make_poses``' arguments."""
    count = int(span * rate) + 1
    poses = exact(scene, rate, count)
    generator = np.random.default_rng(seed)
    place = poses[..., :3] + generator.normal(0.0, SIGMA[0], poses[..., :3].shape)
    turn = rotations.exponential(generator.normal(0.0, SIGMA[1], place.shape))
    turn = rotations.multiply(turn, poses[..., 3:])
    arrays = {
        "time": np.arange(count) / rate,
        "pos": np.moveaxis(place, 1, 0),
        "quat": np.moveaxis(turn, 1, 0),
        "names": np.array(scene.names),
    }
    return make_poses(**{**arrays, **changes})


def acting(name: str, target: str | None = "ball", **parameters: float) -> Scene:
    """The throw with one effect."""
    return dataclasses.replace(THROW, effects=(Effect(name, target, tuple(parameters.items())),))
