"""Effects that every backend carries in the same way: a tilted floor, frames that are missing or doubled."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.effects import acting
from mjx_refine.effects.loading import with_loads
from mjx_refine.errors import InputError

Inner = Callable[[SceneBatch, int, np.ndarray | None], np.ndarray]


def carried(batch: SceneBatch, frames: int, inner: Inner) -> Float[np.ndarray, "batch frames objects 7"]:
    """Poses in the frames that are shown, in the world's axes.

    Args:
      batch: candidates with effects.
      frames: of the clip.
      inner: (batch in the floor's axes, frames, floor to world or None) to poses in the floor's axes.
    """
    shown = acting.shown_frames(batch, frames)
    needed = frames if shown is None else int(shown.max()) + 1
    if shown is not None and batch.restarts:
        restarts = (dataclasses.replace(r, frame=int(shown[0, min(r.frame, frames - 1)])) for r in batch.restarts)
        batch = dataclasses.replace(batch, restarts=tuple(restarts))
    world = acting.floor_rotation(batch)
    poses = inner(batch if world is None else acting.turned_state(batch, np.swapaxes(world, -1, -2)), needed, world)
    if world is not None:
        place = np.einsum("bij,btnj->btni", world, poses[..., :3])
        turn = np.broadcast_to(acting.quaternion_of(world)[:, None, None], poses[..., 3:].shape)
        poses = np.concatenate([place, rotations.multiply(turn, poses[..., 3:])], -1)
    return poses if shown is None else np.take_along_axis(poses, shown[:, :, None, None], 1)


def refuse_loads(batch: SceneBatch, backend: str) -> None:
    """What a compiled rollout cannot ask effects for: forces that depend on the state, friction on the place.

    Raises:
      InputError: the batch has such an effect.
    """
    if batch.restarts:
        raise ValueError(f"backend {backend} restarts no objects; expected C MuJoCo")
    lacking = with_loads(batch)
    if lacking:
        raise InputError(f"effect {lacking[0]}: backend {backend} cannot carry it; use --backend mujoco")
