"""What the numbers of a space are put into, and how they make a scene: between parameters and ``SceneBatch``."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from mjx_refine import rotations
from mjx_refine.batch import BatchEffect, SceneBatch, batch_from_scenes, concatenate
from mjx_refine.scene import Scene, Shape
from mjx_refine.space.effects import FIELD
from mjx_refine.space.layout import is_upright, lowest_extent


@dataclasses.dataclass(frozen=True)
class Origin:
    """Scenes on a level floor, by the quantities that parameters stand for.

    Attributes:
      batch: the scenes.
      raw: field of a parameter -> array whose rows are scenes, to be written to.
      lean: for each lying cylinder the horizontal direction across its axis, zero for the others.
      effects: of the scenes; their numbers are those in ``raw``.
    """

    batch: SceneBatch
    raw: dict[str, Float[np.ndarray, "batch ..."]]
    lean: Float[np.ndarray, "batch objects 3"]
    effects: tuple[BatchEffect, ...]

    @classmethod
    def of(cls, scene: Scene, effects: tuple[BatchEffect, ...]) -> Origin:
        """One scene, with its effects' numbers (batch 1)."""
        batch = batch_from_scenes([scene])
        raw = _quantities(batch)
        raw.update({f"{FIELD}{k}": effect.values for k, effect in enumerate(effects)})
        return cls(batch, raw, _lean_axes(scene)[None], effects)

    @classmethod
    def rows(cls, origins: Sequence[Origin], rows: Int[np.ndarray, "batch"]) -> Origin:
        """Copies of ``rows`` of all origins together."""
        raw = {name: np.concatenate([o.raw[name] for o in origins])[rows] for name in origins[0].raw}
        effects = tuple(
            dataclasses.replace(effect, values=raw[f"{FIELD}{k}"]) for k, effect in enumerate(origins[0].effects)
        )
        # Effects apart: their numbers are in raw already.
        batch = concatenate([dataclasses.replace(o.batch, effects=o.effects) for o in origins])
        batch = dataclasses.replace(batch, effects=())[rows]
        return cls(batch, raw, np.concatenate([o.lean for o in origins])[rows], effects)

    def assembled(self) -> SceneBatch:
        """The scenes that ``raw`` stands for, without effects."""
        base, raw = self.batch, self.raw
        zeros = np.zeros_like(raw["yaw"])
        vertical = rotations.exponential(np.concatenate([zeros, zeros, raw["yaw"]], -1))
        lean = raw["lean"] * self.lean
        tilt = rotations.exponential(np.concatenate([raw["tilt"], zeros], -1) + lean)
        quaternion = rotations.normalise(rotations.multiply(vertical, rotations.multiply(tilt, base.quaternion)))
        position = raw["position"].copy()
        position[..., 2] = raw["clearance"][..., 0] + _extents(base.shapes, raw["size"], quaternion)
        strength = np.linalg.norm(base.gravity, axis=-1, keepdims=True)
        return dataclasses.replace(
            base,
            size=raw["size"],
            mass=raw["mass"][..., 0],
            friction=raw["friction"],
            damping=-raw["resistance"][..., 0],
            position=position,
            quaternion=quaternion,
            linear_velocity=raw["linear_velocity"],
            angular_velocity=rotations.rotate(rotations.conjugate(quaternion), raw["spin"]),
            gravity=base.gravity * (raw["gravity"] / np.where(strength > 0, strength, 1.0)),
            camera_position=raw["camera_position"],
            camera_pitch=raw["camera_pitch"][:, 0],
            camera_fovy=raw["camera_fovy"][:, 0],
        )


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
