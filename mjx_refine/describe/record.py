"""What happens in a scene's simulation, step by step: states, contacts, and pixels of every object."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.effects import acting, batch_with_effects
from mjx_refine.errors import InputError
from mjx_refine.scene import Scene
from mjx_refine.sim.model import SUBSTEPS, apply_fields, build_spec, contact_pairs, initial_state, model_fields
from mjx_refine.view.effects import draw_effects

MOST = 2 * 10**9
"""Elements of the pictures or of the states, at most."""


@dataclasses.dataclass(frozen=True)
class Record:
    """A simulation of N objects over T frames; a state is one physics step, eight a frame, the first the first frame's.

    Attributes:
      scene: what was simulated.
      fps: frames a second.
      size: (width, height) of the pictures [px].
      position: centres, world frame [m].
      quaternion: w x y z, body to world.
      velocity: world frame [m/s].
      spin: world frame [rad/s].
      pairs: (first, second) objects of every possible contact; -1 is the floor.
      touching: whether MuJoCo found a contact of that pair.
      pixels: how many pixels show an object.
    """

    scene: Scene
    fps: float
    size: tuple[int, int]
    position: Float[np.ndarray, "states objects 3"]
    quaternion: Float[np.ndarray, "states objects 4"]
    velocity: Float[np.ndarray, "states objects 3"]
    spin: Float[np.ndarray, "states objects 3"]
    pairs: tuple[tuple[int, int], ...]
    touching: Bool[np.ndarray, "states pairs"]
    pixels: Int[np.ndarray, "frames objects"]

    @property
    def frames(self) -> int:
        """The number of frames T."""
        return len(self.pixels)

    @property
    def step(self) -> float:
        """Seconds between two states."""
        return 1.0 / (self.fps * SUBSTEPS)

    @property
    def duration(self) -> float:
        """Time of the last state [s]."""
        return (len(self.position) - 1) * self.step

    @property
    def poses(self) -> Float[np.ndarray, "frames objects 7"]:
        """Position [m] and quaternion in every frame, as ``Simulator.rollout`` returns them."""
        return np.concatenate([self.position, self.quaternion], -1)[::SUBSTEPS]


def record(scene: Scene, frames: int = 30, fps: float = 30.0, size: tuple[int, int] = (480, 320)) -> Record:
    """Simulates ``scene`` in C MuJoCo and keeps every state and contact.

    Args:
      scene: its effects may change how it is seen, not how it moves.
      frames: number of frames, at least 2.
      fps: frames a second.
      size: (width, height) of the pictures in which objects are seen or not [px].

    Raises:
      InputError: an effect acts on the motion, the simulation diverges, or it would not fit in memory.
    """
    states = (frames - 1) * SUBSTEPS + 1
    pairs = contact_pairs(len(scene.objects))
    if size[0] * size[1] * frames * 2 > MOST or states * (len(pairs) + 13 * len(scene.objects)) > MOST:
        raise InputError(f"{frames} frames of {size[0]}x{size[1]}: too large; choose fewer frames or a smaller size")
    batch = batch_with_effects([scene])
    _refuse_motion_effects(batch, frames)
    qpos, qvel, touching = _rolled(batch, fps, states, pairs)
    bad = ~(np.isfinite(qpos).all((1, 2)) & np.isfinite(qvel).all((1, 2))) | (np.abs(qpos[..., :3]) > 1e4).any((1, 2))
    if bad.any():
        raise InputError(
            f"the simulation diverges in frame {int(np.argmax(bad)) // SUBSTEPS}; lower stiffness or velocities, or "
            "separate the objects"
        )
    masks, _ = draw_effects(qpos[::SUBSTEPS], batch, size, fps)
    pixels = np.stack([(masks == k + 1).sum((1, 2)) for k in range(len(scene.objects))], -1)
    return Record(
        scene=scene,
        fps=fps,
        size=size,
        position=qpos[..., :3],
        quaternion=qpos[..., 3:],
        velocity=qvel[..., :3],
        spin=rotations.rotate(rotations.normalise(qpos[..., 3:]), qvel[..., 3:]),
        pairs=tuple(pairs),
        touching=touching,
        pixels=pixels,
    )


def _refuse_motion_effects(batch: SceneBatch, frames: int) -> None:
    if acting.is_physical(batch) or acting.shown_frames(batch, frames) is not None:
        names = ", ".join(effect.name for effect in batch.effects)
        raise InputError(
            f"effects {names}: a description is of the base model's motion; expected effects on the view alone; remove "
            "the entries that act on motion or timing"
        )


def _rolled(batch: SceneBatch, fps: float, states: int, pairs: list[tuple[int, int]]):
    """States (states, objects, 7) and (states, objects, 6), and contacts (states, pairs)."""
    model = build_spec(batch.shapes, fps).compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    apply_fields(model, model_fields(batch), 0)
    data, count = mujoco.MjData(model), len(batch.shapes)
    start, speed = initial_state(batch)
    data.qpos[:], data.qvel[:] = start[0], speed[0]
    qpos, qvel = np.empty((states, count, 7)), np.empty((states, count, 6))
    touching = np.zeros((states, len(pairs)), bool)
    # Geom 0 is the floor, so that a pair's numbers plus one are its geoms'.
    column = {(first + 1, second + 1): k for k, (first, second) in enumerate(pairs)}
    for k in range(states):
        qpos[k], qvel[k] = data.qpos.reshape(count, 7), data.qvel.reshape(count, 6)
        # A step looks for the contacts of the state that it starts from.
        mujoco.mj_step(model, data)
        for pair in data.contact.geom:
            touching[k, column[int(min(pair)), int(max(pair))]] = True
    return qpos, qvel, touching
