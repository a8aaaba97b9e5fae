"""Rollouts in C MuJoCo whose forces depend on the state: a step at a time, all candidates together."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.effects import acting
from mjx_refine.effects.kind import Loads, Motion
from mjx_refine.effects.loading import Loading
from mjx_refine.sim.model import SUBSTEPS
from mjx_refine.sim.restarts import Restarts

A_STEP = 2e-6
"""What one step of one candidate takes at least [s]: in the air; one on the floor takes 20 us."""


# What diverges is told by its poses.
@np.errstate(over="ignore", invalid="ignore")
def stepped_rollout(
    workers_for: Callable[[float], rollout.Rollout],
    models: list[mujoco.MjModel],
    data: list[mujoco.MjData],
    state: Float[np.ndarray, "batch state"],
    batch: SceneBatch,
    frames: int,
    world: Float[np.ndarray, "batch 3 3"] | None,
    restarts: Restarts,
) -> Float[np.ndarray, "batch intervals positions"]:
    """``qpos`` at the start of frames 1, 2, ... under the loads of the batch's effects.

    The loads of a step are those of the state at its start (explicit, as MuJoCo's Euler integrator has all forces); while
    every effect says that its loads stay as they are, steps are taken together.

    Args:
      workers_for: threads for what takes one of them so long [s].
      models: one a candidate; the floor's friction is written into them and put back.
      data: one a thread.
      state: full physics state at the first frame.
      batch: the candidates with their effects, in the floor's axes.
      frames: of the clip.
      world: floor to world, where they differ: effects think in the world's axes.
      restarts: of objects along the way.
    """
    count, objects = batch.mass.shape
    positions, step = 7 * objects, models[0].opt.timestep
    usual = np.array([model.pair_friction[:objects, 0] for model in models])
    current, warm = usual.copy(), np.zeros((count, models[0].nv))
    result = np.empty((count, frames - 1, positions))
    spec = mujoco.mjtState.mjSTATE_XFRC_APPLIED.value
    centre = acting.centre_of_mass(batch)
    turned = None if world is None else (world, acting.quaternion_of(world)[:, None])
    loading, applied = Loading(batch), np.zeros((count, 1, 6 * models[0].nbody))
    k, last, a_step = 0, (frames - 1) * SUBSTEPS, A_STEP
    while k < last:
        motion = _motion(state, batch, k * step, step, turned, loading)
        idle = loading.idle(motion)
        most = SUBSTEPS * restarts.after(k // SUBSTEPS, frames - 1) - k
        steps = 1 if idle == 0.0 or np.isnan(idle) else int(np.clip(min(idle, 1e3) // step, 1, most))
        told = loading.loads(motion)
        if centre is not None and told is not None:
            told = _about_the_mass(told, motion, centre)
            # A force that stays as it is turns a body that rotates about a mass elsewhere ever differently.
            steps = 1 if told[0].any() else steps
        _write(told, world, applied)
        current = _rubbed(models, usual, current, loading.floor_friction(motion))
        # Checks of shapes would take as long as a step.
        states, nothing = np.empty((count, steps, state.shape[1])), np.empty((count, steps, 0))
        workers, begun = workers_for(count * steps * a_step), perf_counter()
        workers.rollout(
            models,
            data[: workers.nthread or 1],
            state,
            applied if steps == 1 else np.repeat(applied, steps, 1),
            control_spec=spec,
            nstep=steps,
            initial_warmstart=warm,
            state=states,
            sensordata=nothing,
            skip_checks=True,
        )
        a_step = (perf_counter() - begun) * max(workers.nthread, 1) / (count * steps)
        for end in range(-(-(k + 1) // SUBSTEPS) * SUBSTEPS, k + steps + 1, SUBSTEPS):
            result[:, end // SUBSTEPS - 1] = states[:, end - k - 1, 1 : 1 + positions]
        state, k = states[:, 0] if steps == 1 else states[:, -1].copy(), k + steps
        if k % SUBSTEPS == 0 and restarts.begin(k // SUBSTEPS, state):
            result[:, k // SUBSTEPS - 1] = state[:, 1 : 1 + positions]
    for row, model in enumerate(models):
        model.pair_friction[:objects, :2] = usual[row, :, None]
    return result


def _rubbed(
    models: list[mujoco.MjModel], usual: np.ndarray, current: np.ndarray, friction: np.ndarray | None
) -> np.ndarray:
    """The floor's friction with every object, (batch, objects), once it is written into the models where it changes."""
    if friction is None:
        return current
    wanted = np.where(np.isnan(friction), usual, friction)
    for row in np.nonzero((wanted != current).any(1))[0]:
        models[row].pair_friction[: usual.shape[1], :2] = wanted[row, :, None]
    return wanted


def _write(told: Loads | None, world: np.ndarray | None, applied: Float[np.ndarray, "batch 1 bodies_6"]) -> None:
    """Writes loads on all bodies in the floor's axes, force and torque of each; the first body is the world."""
    if told is None:
        applied.fill(0.0)
        return
    bodies = applied.reshape(len(applied), -1, 6)
    for part, load in enumerate(told):
        bodies[:, 1:, 3 * part : 3 * part + 3] = load if world is None else np.einsum("bji,bnj->bni", world, load)
    flat = applied.reshape(-1)
    # Of what is finite the square is, but for what is huge.
    if not np.isfinite(flat @ flat):
        np.nan_to_num(applied, copy=False)


def _about_the_mass(told: Loads, motion: Motion, centre: np.ndarray) -> Loads:
    """Loads about the centres of mass, where MuJoCo applies them, from those about the bodies' centres."""
    force, torque = told
    return force, torque - rotations.cross(rotations.turned(motion.axes, centre), force)


def _motion(
    state: np.ndarray,
    batch: SceneBatch,
    time: float,
    step: float,
    world: tuple[np.ndarray, np.ndarray] | None,
    loading: Loading,
) -> Motion:
    """The state in the world's axes; ``world``: how the floor's are turned, as matrices and as quaternions."""
    count, objects = batch.mass.shape
    qpos = state[:, 1 : 1 + 7 * objects].reshape(count, objects, 7)
    qvel = state[:, 1 + 7 * objects : 1 + 13 * objects].reshape(count, objects, 6)
    position, quaternion, velocity = qpos[..., :3], qpos[..., 3:], qvel[..., :3]
    if world is not None:
        position, velocity = (np.einsum("bij,bnj->bni", world[0], v) for v in (position, velocity))
        quaternion = rotations.multiply(world[1], quaternion)
    return Motion(time, step, position, quaternion, velocity, qvel[..., 3:], batch, loading.lasting)
