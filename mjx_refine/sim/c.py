"""The reference backend: MuJoCo's C engine, one model a candidate, on all cores."""

from __future__ import annotations

import copy
import os

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from mujoco import rollout

from mjx_refine.batch import SceneBatch
from mjx_refine.effects import acting
from mjx_refine.effects.loading import has_loads
from mjx_refine.scene import Shape
from mjx_refine.sim import cores
from mjx_refine.sim.buckets import diverged_to_nan
from mjx_refine.sim.carried import carried
from mjx_refine.sim.model import IDLE, SUBSTEPS, Edited, build_spec, field_arrays, initial_state, model_fields
from mjx_refine.sim.restarts import Restarts
from mjx_refine.sim.stepped import A_STEP, stepped_rollout

# MuJoCo's default handler appends to MUJOCO_LOG.TXT in the working directory. A candidate that diverges is no news.
mujoco.set_mju_user_warning(lambda _message: None)

A_THREAD = 100e-6
"""Work that is worth one more thread [s]: to wake it takes 25 to 50 us."""


class MujocoSimulator:
    """Batched rollouts in C MuJoCo; models are built once and edited in place.

    Args:
      shapes: the scene kind.
      fps: frames a second; the time step is 1 / (8 fps).
      threads: worker threads at most, and not more than this process's part of ``cores``; all cores by default. The result
        does not depend on it.
    """

    name = "mujoco"
    device = "cpu"

    def __init__(self, shapes: tuple[Shape, ...], fps: float, threads: int | None = None):
        self.shapes = shapes
        self.fps = fps
        self.threads = threads or os.cpu_count() or 1
        self.model = self._compiled(False)
        """Of which every candidate has an edited copy."""
        self._data = [mujoco.MjData(self.model) for _ in range(self.threads)]
        self._edited: list[Edited] = []
        self._off_centre: tuple[mujoco.MjModel, list[mujoco.MjData], list[Edited]] | None = None
        self._workers: dict[int, rollout.Rollout] = {}

    def _workers_for(self, work: float) -> rollout.Rollout:
        """Threads for what takes one of them so long [s]; this one alone for little."""
        worth = min(self.threads, cores.PROCESS.mine, int(work / A_THREAD))
        # A power of two, or all: few pools serve all calls.
        threads = 0 if worth < 2 else worth if worth == self.threads else 1 << (worth.bit_length() - 1)
        if threads not in self._workers:
            self._workers[threads] = rollout.Rollout(nthread=threads)
        return self._workers[threads]

    def _compiled(self, off_centre: bool) -> mujoco.MjModel:
        model = build_spec(self.shapes, self.fps, off_centre=off_centre).compile()
        # A diverged candidate must stay diverged: a silent reset would score its first frame again.
        model.opt.disableflags |= IDLE | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        return model

    def _prepare(self, batch: SceneBatch) -> list[mujoco.MjModel]:
        return self._prepared(batch)[0]

    def _prepared(self, batch: SceneBatch) -> tuple[list[mujoco.MjModel], list[mujoco.MjData]]:
        """One model a candidate, edited in place, and data for the threads."""
        if batch.shapes != self.shapes:
            raise ValueError(f"scene kind {batch.shapes}; this simulator was made for {self.shapes}")
        centre = acting.centre_of_mass(batch) if batch.effects else None
        model, data, edited = self.model, self._data, self._edited
        if centre is not None:
            if self._off_centre is None:
                model = self._compiled(True)
                self._off_centre = model, [mujoco.MjData(model) for _ in range(self.threads)], []
            model, data, edited = self._off_centre
        fields = model_fields(batch)
        arrays = field_arrays(self.shapes, fields, centre)
        while len(edited) < len(batch):
            edited.append(Edited(copy.copy(model), arrays))
        inertia = arrays["dof_M0"].mean(1)
        for row, one in enumerate(edited[: len(batch)]):
            one.write([array[row] for array in arrays.values()], inertia[row], fields.gravity[row])
        return [one.model for one in edited[: len(batch)]], data

    def rollout(self, batch: SceneBatch, frames: int) -> Float[np.ndarray, "batch frames objects 7"]:
        """Poses (position [m], quaternion wxyz) at the start of every frame; NaN from where a candidate diverged.

        With effects that act on motion and timing; those on the view are ``effects.acting.apparent``'s.
        """
        return self.shot(batch, frames)[0]

    def shot(
        self, batch: SceneBatch, frames: int
    ) -> tuple[Float[np.ndarray, "batch frames objects 7"], Float[np.ndarray, "batch restarts 13"]]:
        """As ``rollout``, and the states in which objects arrive where they restart; NaN where that is later."""
        arrived = np.full((len(batch), len(batch.restarts), 13), np.nan)

        def inner(inside: SceneBatch, needed: int, world: np.ndarray | None) -> np.ndarray:
            restarts = Restarts(inside, len(self.shapes), needed)
            positions = self._positions(inside, needed, world, restarts)
            arrived[:] = restarts.arrived if world is None else acting.turned_states(restarts.arrived, world)
            return self._finished(positions, inside, needed)

        return (carried(batch, frames, inner) if batch.effects else inner(batch, frames, None)), arrived

    def _positions(self, batch: SceneBatch, frames: int, world: np.ndarray | None, restarts: Restarts) -> np.ndarray:
        """``qpos`` in every frame, (batch, frames, 7 N)."""
        models, data = self._prepared(batch)
        qpos, qvel = initial_state(batch)
        first = qpos.reshape(len(batch), 1, -1)
        if frames == 1:
            return first
        size = mujoco.mj_stateSize(models[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        state = np.zeros((len(batch), size))
        state[:, 1 : 1 + qpos.shape[1] + qvel.shape[1]] = np.concatenate([qpos, qvel], 1)
        if batch.effects and has_loads(batch):
            later = stepped_rollout(self._workers_for, models, data, state, batch, frames, world, restarts)
            return np.concatenate([first, later], 1)
        parts, frame = [first], 0
        while frame < frames - 1:
            until = restarts.after(frame, frames - 1)
            steps = (until - frame) * SUBSTEPS
            workers = self._workers_for(steps * len(batch) * A_STEP)
            states = np.asarray(workers.rollout(models, data[: workers.nthread or 1], state, nstep=steps)[0])
            shown = states[:, SUBSTEPS - 1 :: SUBSTEPS]
            state, frame = shown[:, -1].copy(), until
            if restarts.begin(frame, state):
                shown = np.concatenate([shown[:, :-1], state[:, None]], 1)
            parts.append(shown[..., 1 : 1 + qpos.shape[1]])
        return np.concatenate(parts, 1)

    def _finished(self, positions: np.ndarray, batch: SceneBatch, frames: int) -> np.ndarray:
        return diverged_to_nan(positions.reshape(len(batch), frames, len(self.shapes), 7))

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
        near = np.nonzero(_spheres_meet(batch))[0]
        if not len(near):
            return depth
        models = self._prepare(batch[near])
        qpos, _ = initial_state(batch)
        data = self._data[0]
        for row, model in zip(near, models, strict=True):
            data.qpos[:] = qpos[row]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            contact = data.contact
            if len(contact):
                between = contact.geom.min(axis=1) > 0
                depth[row] = np.max(-contact.dist[between], initial=0.0)
        return depth


def _spheres_meet(batch: SceneBatch) -> Bool[np.ndarray, "batch"]:
    """Whether any two objects' bounding spheres meet in the first frame: else nothing touches."""
    radius = model_fields(batch).geom_rbound
    apart = np.linalg.norm(batch.position[:, :, None] - batch.position[:, None], axis=-1)
    meet = apart < 1.001 * (radius[:, :, None] + radius[:, None])
    return (meet & ~np.eye(radius.shape[1], dtype=bool)).any((1, 2))
