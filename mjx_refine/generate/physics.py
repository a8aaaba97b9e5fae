"""Rollouts in C MuJoCo that also keep velocities and what MuJoCo's contact sensors say in every step."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float, Int
from mujoco import rollout

from mjx_refine.batch import SceneBatch
from mjx_refine.generate.options import FPS, FRAMES
from mjx_refine.scene import Shape
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.model import SUBSTEPS, build_spec, contact_pairs, initial_state

_DATA = mujoco.mjtConDataField
_FIELDS = sum(1 << field.value for field in (_DATA.mjCONDATA_FOUND, _DATA.mjCONDATA_FORCE, _DATA.mjCONDATA_POS))
_WIDTH = 7
_NET_FORCE = 3
"""Contacts of a pair are told as one force, in the world's axes, at their force-weighted middle."""


@dataclasses.dataclass(frozen=True)
class Contacts:
    """What touched in one clip, a row for each pair of bodies and physics step in which MuJoCo found a contact.

    Attributes:
      step: physics steps since the first frame, eight a frame.
      pair: (first, second) objects; -1 is the floor.
      points: how many contact points there were.
      force: on the second body, world frame [N].
      position: of the force-weighted middle of the points [m].
    """

    step: Int[np.ndarray, "rows"]
    pair: Int[np.ndarray, "rows 2"]
    points: Int[np.ndarray, "rows"]
    force: Float[np.ndarray, "rows 3"]
    position: Float[np.ndarray, "rows 3"]


@dataclasses.dataclass(frozen=True)
class Motion:
    """One scene's states at the start of every frame, as MuJoCo has them, and its contacts.

    Attributes:
      qpos: of each object, position [m] and quaternion wxyz.
      qvel: of each object, world-frame linear [m/s] and body-frame angular velocity [rad/s].
      contacts: of all steps from the first frame to the last.
    """

    qpos: Float[np.ndarray, "frames objects 7"]
    qvel: Float[np.ndarray, "frames objects 6"]
    contacts: Contacts

    @property
    def finite(self) -> bool:
        """Whether the simulation stayed sound."""
        return bool(np.isfinite(self.qpos).all() and np.isfinite(self.qvel).all() and np.abs(self.qpos).max() < 1e4)


class RecordingSimulator(MujocoSimulator):
    """``MujocoSimulator`` whose models have a contact sensor for each pair; sensors change no motion."""

    def __init__(self, shapes: tuple[Shape, ...]):
        super().__init__(shapes, FPS, threads=1)
        self._pairs = np.array(contact_pairs(len(shapes)), np.int8)

    def _compiled(self, off_centre: bool) -> mujoco.MjModel:
        spec = build_spec(self.shapes, self.fps, off_centre=off_centre)
        for pair in list(spec.pairs):
            spec.add_sensor(
                name=f"{pair.geomname1}-{pair.geomname2}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=pair.geomname1,
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname=pair.geomname2,
                intprm=[_FIELDS, _NET_FORCE, 1],
            )
        model = spec.compile()
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        return model

    def record(self, batch: SceneBatch, frames: int = FRAMES) -> list[Motion]:
        """The motion of every scene of ``batch``; no effects."""
        models, data = self._prepared(batch)
        qpos, qvel = initial_state(batch)
        nq, nv, count = qpos.shape[1], qvel.shape[1], len(self.shapes)
        state = np.zeros((len(batch), mujoco.mj_stateSize(models[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        state[:, 1 : 1 + nq + nv] = np.concatenate([qpos, qvel], 1)
        # Sensors tell of the state that a step starts from; one more step tells of the last frame's.
        states, sensed = rollout.rollout(models, data, state, nstep=(frames - 1) * SUBSTEPS + 1)
        states, sensed = np.asarray(states), np.asarray(sensed)
        kept = np.concatenate([state[:, None], states[:, SUBSTEPS - 1 :: SUBSTEPS]], 1)[:, :frames, 1 : 1 + nq + nv]
        return [
            Motion(
                kept[row, :, :nq].reshape(frames, count, 7),
                kept[row, :, nq:].reshape(frames, count, 6),
                self._contacts(sensed[row].reshape(len(sensed[row]), len(self._pairs), _WIDTH)),
            )
            for row in range(len(batch))
        ]

    def _contacts(self, sensed: Float[np.ndarray, "steps pairs 7"]) -> Contacts:
        step, pair = np.nonzero(sensed[..., 0] > 0)
        found = sensed[step, pair]
        return Contacts(
            step=step.astype(np.uint16),
            pair=self._pairs[pair],
            points=found[:, 0].astype(np.uint8),
            force=found[:, 1:4].astype(np.float32),
            position=found[:, 4:7].astype(np.float32),
        )
