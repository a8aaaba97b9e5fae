"""The reference backend: MuJoCo's C engine, one model a candidate, on all cores."""

from __future__ import annotations

import copy
import os

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.effects import acting
from mjx_refine.scene import Shape
from mjx_refine.sim.model import SUBSTEPS, apply_fields, build_spec, initial_state, model_fields
from mjx_refine.sim.stepped import stepped_rollout

# MuJoCo's default handler appends to MUJOCO_LOG.TXT in the working directory. A candidate that diverges is no news.
mujoco.set_mju_user_warning(lambda _message: None)


class MujocoSimulator:
    """Batched rollouts in C MuJoCo; models are built once and edited in place.

    Args:
      shapes: the scene kind.
      fps: frames a second; the time step is 1 / (8 fps).
      threads: worker threads; all cores by default. The result does not depend on it.
    """

    name = "mujoco"
    device = "cpu"

    def __init__(self, shapes: tuple[Shape, ...], fps: float, threads: int | None = None):
        self.shapes = shapes
        self.fps = fps
        self.threads = threads or os.cpu_count() or 1
        model = build_spec(shapes, fps).compile()
        # A diverged candidate must stay diverged: a silent reset would score its first frame again.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._models = [model]
        self._data = [mujoco.MjData(model) for _ in range(self.threads)]
        self._pool: rollout.Rollout | None = None

    def _prepare(self, batch: SceneBatch) -> list[mujoco.MjModel]:
        if batch.shapes != self.shapes:
            raise ValueError(f"scene kind {batch.shapes}; this simulator was made for {self.shapes}")
        while len(self._models) < len(batch):
            self._models.append(copy.copy(self._models[0]))
        fields = model_fields(batch)
        centre = acting.centre_of_mass(batch) if batch.effects else None
        for row in range(len(batch)):
            apply_fields(self._models[row], fields, row, None if centre is None else centre[row])
        return self._models[: len(batch)]

    def rollout(self, batch: SceneBatch, frames: int) -> Float[np.ndarray, "batch frames objects 7"]:
        """Poses (position [m], quaternion wxyz) at the start of every frame; NaN from where a candidate diverged.

        With effects that act on motion and timing; those on the view are ``effects.acting.apparent``'s.
        """
        if batch.effects:
            return self._rollout_with_effects(batch, frames)
        return self._finished(self._positions(batch, frames, None), batch, frames)

    def _positions(self, batch: SceneBatch, frames: int, world: np.ndarray | None) -> np.ndarray:
        """``qpos`` in every frame, (batch, frames, 7 N)."""
        models = self._prepare(batch)
        qpos, qvel = initial_state(batch)
        first = qpos.reshape(len(batch), 1, -1)
        if frames == 1:
            return first
        size = mujoco.mj_stateSize(models[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        state = np.zeros((len(batch), size))
        state[:, 1 : 1 + qpos.shape[1] + qvel.shape[1]] = np.concatenate([qpos, qvel], 1)
        if batch.effects and acting.has_loads(batch):
            if self._pool is None:
                self._pool = rollout.Rollout(nthread=self.threads if self.threads > 1 else 0)
            data = self._data if self.threads > 1 else self._data[:1]
            later = stepped_rollout(self._pool, models, data, state, batch, frames, world)
        else:
            states, _ = rollout.rollout(models, self._data, state, nstep=(frames - 1) * SUBSTEPS)
            later = np.asarray(states)[:, SUBSTEPS - 1 :: SUBSTEPS, 1 : 1 + qpos.shape[1]]
        return np.concatenate([first, later], 1)

    def _rollout_with_effects(self, batch: SceneBatch, frames: int) -> np.ndarray:
        shown = acting.shown_frames(batch, frames)
        needed = frames if shown is None else int(shown.max()) + 1
        world = acting.floor_rotation(batch)
        inside = batch if world is None else acting.turned_state(batch, np.swapaxes(world, -1, -2))
        poses = self._finished(self._positions(inside, needed, world), batch, needed)
        if world is not None:
            place = np.einsum("bij,btnj->btni", world, poses[..., :3])
            turn = np.broadcast_to(acting.quaternion_of(world)[:, None, None], poses[..., 3:].shape)
            poses = np.concatenate([place, rotations.multiply(turn, poses[..., 3:])], -1)
        return poses if shown is None else np.take_along_axis(poses, shown[:, :, None, None], 1)

    def _finished(self, positions: np.ndarray, batch: SceneBatch, frames: int) -> np.ndarray:
        poses = positions.reshape(len(batch), frames, len(self.shapes), 7)
        bad = ~np.isfinite(poses).all((2, 3)) | (np.abs(poses[..., :3]) > 1e4).any((2, 3))
        bad = np.logical_or.accumulate(bad, axis=1)
        return np.where(bad[:, :, None, None], np.nan, poses)

    def contacts(self, batch: SceneBatch, row: int, margin: float = 0.0) -> list[tuple[int, int, float, np.ndarray]]:
        """Contacts of the first frame: (first object, second, distance [m], normal from first to second); -1: floor."""
        model = self._prepare(batch[row : row + 1])[0]
        data = self._data[0]
        model.pair_margin[:] = margin
        qpos, _ = initial_state(batch[row : row + 1])
        data.qpos[:] = qpos[0]
        data.qvel[:] = 0.0
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        model.pair_margin[:] = 0.0
        return [(int(c.geom[0]) - 1, int(c.geom[1]) - 1, float(c.dist), np.array(c.frame[:3])) for c in data.contact]

    def overlap(self, batch: SceneBatch) -> Float[np.ndarray, "batch"]:
        """Deepest penetration between two objects in the first frame [m], 0 where none touch."""
        depth = np.zeros(len(batch))
        if len(self.shapes) < 2:
            return depth
        models = self._prepare(batch)
        qpos, _ = initial_state(batch)
        data = self._data[0]
        for row, model in enumerate(models):
            data.qpos[:] = qpos[row]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            contact = data.contact
            if len(contact):
                between = contact.geom.min(axis=1) > 0
                depth[row] = np.max(-contact.dist[between], initial=0.0)
        return depth
