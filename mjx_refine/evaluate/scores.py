"""Scores of a scene against a clip, and its parameters against the truth."""

from __future__ import annotations

import math

import numpy as np

from mjx_refine import rotations
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Body, Samples, Scene
from mjx_refine.search.options import Options
from mjx_refine.search.problem import Problem


def evaluate_scene(scene: Scene, observation: Observation) -> dict:
    """IoU, EPE and fitness of a scene, simulated by C MuJoCo and compared at full resolution.

    Returns:
      ``iou, first_frame_iou, epe, first_frame_epe, object_epe, fitness`` [1 and px] and ``objects``.
    """
    start = Problem(Samples("<scene>", (scene,), (0,)), observation, Options()).starts[0]
    scores = start.scores

    def number(value: float) -> float | None:
        return round(float(value), 6) if math.isfinite(value) else None

    return {
        "iou": number(scores.iou[0]),
        "first_frame_iou": number(scores.first_frame_iou[0]),
        "epe": number(scores.epe[0]),
        "first_frame_epe": number(scores.first_frame_epe[0]),
        "object_epe": number(scores.object_epe[0]),
        "fitness": number(scores.fitness[0]),
        "objects": [
            {"name": name, "mask_id": i if i >= 0 else None, "iou": number(iou)}
            for name, i, iou in zip(scene.names, start.matching, scores.object_iou[0], strict=True)
        ],
    }


def compare_scenes(scene: Scene, truth: Scene, source: str = "<truth>") -> dict:
    """Absolute errors of every parameter: means over the objects, and camera and gravity.

    Objects are paired by name where all names agree, else by order.

    Raises:
      InputError: the scenes differ in number or type of objects.
    """
    pairs = _pairs(scene, truth, source)

    def mean(values: list[float]) -> float:
        return round(float(np.mean(values)), 6)

    def distance(attribute: str) -> float:
        return mean([math.dist(getattr(a, attribute), getattr(b, attribute)) for a, b in pairs])

    return {
        "position_m": distance("position"),
        "orientation_deg": mean([_turn(a, b) for a, b in pairs]),
        "linear_velocity_m_s": distance("linear_velocity"),
        "angular_velocity_rad_s": mean([_spin(a, b) for a, b in pairs]),
        "size_relative": mean([abs(p / q - 1) for a, b in pairs for p, q in zip(a.size, b.size, strict=True)]),
        "mass_relative": mean([abs(a.mass / b.mass - 1) for a, b in pairs]),
        "sliding_friction": mean([abs(a.friction[0] - b.friction[0]) for a, b in pairs]),
        "rolling_friction": mean([abs(a.friction[1] - b.friction[1]) for a, b in pairs]),
        "damping": mean([abs(a.damping - b.damping) for a, b in pairs]),
        "camera_height_m": abs(scene.camera.position[2] - truth.camera.position[2]),
        "camera_pitch_deg": abs(scene.camera.orientation - truth.camera.orientation),
        "camera_fovy_deg": abs(scene.camera.fovy - truth.camera.fovy),
        "gravity_m_s2": math.dist(scene.gravity, truth.gravity),
    }


def _pairs(scene: Scene, truth: Scene, source: str) -> list[tuple[Body, Body]]:
    if sorted(scene.names) == sorted(truth.names):
        others = {body.name: body for body in truth.objects}
        pairs = [(body, others[body.name]) for body in scene.objects]
    else:
        pairs = list(zip(scene.objects, truth.objects, strict=False))
    if len(scene.objects) != len(truth.objects) or any(a.shape != b.shape for a, b in pairs):
        raise InputError(
            f"{source}: objects {truth.shapes}; expected the scene's {scene.shapes}; compare like with like"
        )
    return pairs


def _turn(a: Body, b: Body) -> float:
    """Angle between orientations [degree], of what a primitive's outline shows: a cylinder's axis, nothing of a sphere."""
    if a.shape == "sphere":
        return 0.0
    if a.shape == "cylinder":
        axes = [rotations.matrix(np.array(body.orientation))[:, 2] for body in (a, b)]
        return math.degrees(math.acos(min(abs(float(axes[0] @ axes[1])), 1.0)))
    return math.degrees(2 * math.acos(min(abs(float(np.dot(a.orientation, b.orientation))), 1.0)))


def _spin(a: Body, b: Body) -> float:
    """Distance of angular velocities in the world frame [rad/s]."""
    spins = [rotations.rotate(np.array(body.orientation), np.array(body.angular_velocity)) for body in (a, b)]
    return float(np.linalg.norm(spins[0] - spins[1]))
