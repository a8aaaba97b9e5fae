"""What the numbers of a space are put into, and how they make a scene: between parameters and ``SceneBatch``."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch, concatenate
from mjx_refine.effects.acting import batch_with_effects, on_the_floor
from mjx_refine.scene import Scene, Shape
from mjx_refine.space.effects import FIELD
from mjx_refine.space.layout import STRONGEST, is_upright, lowest_extent


@dataclasses.dataclass(frozen=True)
class Origin:
    """Scenes on a level floor, by the quantities that parameters stand for.

    Attributes:
      batch: the scenes with their effects.
      raw: field of a parameter -> array whose rows are scenes, to be written to; those of effects are ``batch``'s own.
      lean: for each lying cylinder the horizontal direction across its axis, zero for the others.
    """

    batch: SceneBatch
    raw: dict[str, Float[np.ndarray, "batch ..."]]
    lean: Float[np.ndarray, "batch objects 3"]

    @classmethod
    def of(cls, scene: Scene) -> Origin:
        """One scene (batch 1).

        Raises:
          InputError: an effect is wrong.
        """
        batch = batch_with_effects([scene])
        return cls(batch, {**_quantities(batch), **_numbers_of_effects(batch)}, _lean_axes(scene)[None])

    @classmethod
    def rows(cls, origins: Sequence[Origin], rows: Int[np.ndarray, "batch"]) -> Origin:
        """Copies of ``rows`` of all origins together."""
        batch = concatenate([origin.batch for origin in origins])[rows]
        raw = {name: np.concatenate([origin.raw[name] for origin in origins])[rows] for name in origins[0].raw}
        lean = np.concatenate([origin.lean for origin in origins])[rows]
        return cls(batch, {**raw, **_numbers_of_effects(batch)}, lean)

    def assembled(self) -> SceneBatch:
        """The scenes that ``raw`` stands for, on the floor that their effects make."""
        base, raw = self.batch, self.raw
        zeros = np.zeros_like(raw["yaw"])
        vertical = rotations.exponential(np.concatenate([zeros, zeros, raw["yaw"]], -1))
        lean = raw["lean"] * self.lean
        tilt = rotations.exponential(np.concatenate([raw["tilt"], zeros], -1) + lean)
        quaternion = rotations.normalise(rotations.multiply(vertical, rotations.multiply(tilt, base.quaternion)))
        position = raw["position"].copy()
        position[..., 2] = raw["clearance"][..., 0] + _extents(base.shapes, raw["size"], quaternion)
        strength = np.linalg.norm(base.gravity, axis=-1, keepdims=True)
        gravity = base.gravity * (raw["gravity"] / np.where(strength > 0, strength, 1.0))
        level = dataclasses.replace(
            base,
            size=raw["size"],
            mass=raw["mass"][..., 0],
            friction=raw["friction"],
            damping=-raw["resistance"][..., 0],
            grip=raw["grip"][..., 0],
            position=position,
            quaternion=quaternion,
            linear_velocity=raw["linear_velocity"],
            angular_velocity=rotations.rotate(rotations.conjugate(quaternion), raw["spin"]),
            gravity=np.clip(gravity, -STRONGEST, STRONGEST),  # of a scene at that limit, rounding may exceed it
            camera_position=raw["camera_position"],
            camera_pitch=raw["camera_pitch"][:, 0],
            camera_fovy=raw["camera_fovy"][:, 0],
        )
        return on_the_floor(level) if level.effects else level


def _numbers_of_effects(batch: SceneBatch) -> dict[str, np.ndarray]:
    return {f"{FIELD}{k}": effect.values for k, effect in enumerate(batch.effects)}


def _quantities(base: SceneBatch) -> dict[str, np.ndarray]:
    count, objects = base.mass.shape
    extent = _extents(base.shapes, base.size, base.quaternion)
    return {
        "size": base.size.copy(),
        "position": base.position.copy(),
        "clearance": (base.position[..., 2] - extent)[..., None],
        "yaw": np.zeros((count, objects, 1)),
        "tilt": np.zeros((count, objects, 2)),
        "lean": np.zeros((count, objects, 1)),
        "linear_velocity": base.linear_velocity.copy(),
        "spin": rotations.rotate(base.quaternion, base.angular_velocity),
        "friction": base.friction.copy(),
        "resistance": -base.damping[..., None],
        "grip": base.grip[..., None].copy(),
        "mass": base.mass[..., None].copy(),
        "camera_position": base.camera_position.copy(),
        "camera_pitch": base.camera_pitch[:, None].copy(),
        "camera_fovy": base.camera_fovy[:, None].copy(),
        "gravity": np.linalg.norm(base.gravity, axis=-1, keepdims=True),
    }


def _extents(shapes: tuple[Shape, ...], size: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    return np.stack([lowest_extent(s, size[:, i], quaternion[:, i]) for i, s in enumerate(shapes)], 1)


def _lean_axes(scene: Scene) -> Float[np.ndarray, "objects 3"]:
    axes = np.zeros((len(scene.objects), 3))
    for i, body in enumerate(scene.objects):
        if body.shape == "cylinder" and not is_upright(body):
            axis = rotations.matrix(np.array(body.orientation))[:, 2]
            across = np.cross([0.0, 0.0, 1.0], axis)
            axes[i] = across / np.linalg.norm(across)
    return axes
