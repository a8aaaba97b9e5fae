"""MJX-Warp: MuJoCo's own algorithms as CUDA kernels, called from JAX; for NVIDIA GPUs."""

from __future__ import annotations

import functools
import importlib.util
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.compile_cache import compiling
from mjx_refine.effects import acting
from mjx_refine.errors import InputError
from mjx_refine.scene import Shape
from mjx_refine.sim.carried import carried, refuse_loads
from mjx_refine.sim.leaves import Leaves, candidate_model, leaves_of
from mjx_refine.sim.mjx import diverged_to_nan, padded
from mjx_refine.sim.mjx_import import mjx
from mjx_refine.sim.model import SUBSTEPS, build_spec, contact_pairs, initial_state

REMEDY = "pip install 'mjx-refine[warp]' on a machine with an NVIDIA GPU, or choose --backend mujoco"

_ITERATION_WARNINGS = (1 << 9) | (1 << 10)
"""Warp's ``OverflowType.ITERATIONS`` and ``LS_ITERATIONS``."""

_POINTS = {("floor", "sphere"): 1, ("floor", "box"): 8, ("floor", "cylinder"): 4}


def warp_problem() -> str | None:
    """Why MJX-Warp cannot run here, or None where it can."""
    if importlib.util.find_spec("warp") is None:
        return "the package warp-lang is not installed"
    try:
        found = jax.devices("cuda")
    except RuntimeError:
        found = []
    return None if found else "JAX sees no NVIDIA GPU"


def contact_points(shapes: tuple[Shape, ...]) -> int:
    """The most contacts that one candidate can have: per pair, those of MuJoCo's colliders."""
    total = 0
    for first, second in contact_pairs(len(shapes)):
        kinds = ("floor" if first < 0 else shapes[first], shapes[second])
        total += 1 if "sphere" in kinds else _POINTS.get(kinds, 8)
    return total


class WarpSimulator:
    """Batched rollouts in MJX-Warp.

    Args:
      shapes: the scene kind.
      fps: frames a second; the time step is 1 / (8 fps).
      iterations: Newton iterations a step at most.
      ls_iterations: line-search iterations a Newton iteration at most.
      any_device: also run on a CPU (through Warp's CPU kernels, slow; for tests).
      off_centre: for centres of mass that are not at the bodies' centres.

    Raises:
      InputError: Warp is not installed, or there is no NVIDIA GPU.
    """

    name = "warp"

    def __init__(
        self,
        shapes: tuple[Shape, ...],
        fps: float,
        iterations: int = 50,
        ls_iterations: int = 50,
        any_device: bool = False,
        off_centre: bool = False,
    ):
        problem = warp_problem()
        if problem and not (any_device and importlib.util.find_spec("warp")):
            raise InputError(f"backend warp: {problem}; {REMEDY}")
        self.shapes = shapes
        self.fps = fps
        self._beside = functools.cache(lambda: WarpSimulator(shapes, fps, iterations, ls_iterations, any_device, True))
        self.device = jax.devices()[0].device_kind
        self._mujoco = build_spec(shapes, fps, off_centre=off_centre).compile()
        self._mujoco.opt.iterations = iterations
        self._mujoco.opt.ls_iterations = ls_iterations
        model = mjx.put_model(self._mujoco, impl="warp")
        # Too few iterations in some step are no news (the solver went as far as it may); too few contacts would be.
        silent = model.opt._impl.warn_overflow & ~_ITERATION_WARNINGS
        self._model = cast(mjx.Model, model.tree_replace({"opt._impl.warn_overflow": silent}))
        self._programs: dict[tuple[int, int], jax.stages.Compiled] = {}

    def _data(self, size: int) -> mjx.Data:
        """Empty data with room for the contacts of ``size`` candidates."""
        points = contact_points(self.shapes)
        # Warp keeps one list of contacts for all candidates, and constraint rows for each: six a contact.
        return mjx.make_data(self._mujoco, impl="warp", naconmax=size * points, njmax=6 * points)

    def _trajectory(
        self, data: mjx.Data, leaves: Leaves, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], frames: int
    ) -> Float[Array, "frames objects 7"]:
        model = candidate_model(self._model, leaves, self.shapes)

        def substep(data, _):
            return mjx.step(model, data), None

        def frame(data, _):
            data, _ = jax.lax.scan(substep, data, None, length=SUBSTEPS)
            return data, data.qpos

        start = data.replace(qpos=qpos, qvel=qvel)
        _, later = jax.lax.scan(frame, start, None, length=frames - 1)
        return jnp.concatenate([qpos[None], later]).reshape(frames, len(self.shapes), 7)

    def _program(self, arguments: tuple[Leaves, jax.Array, jax.Array], frames: int) -> jax.stages.Compiled:
        size = len(arguments[1])
        if (size, frames) not in self._programs:
            with compiling(f"MJX-Warp physics of {'+'.join(self.shapes)}, {size} candidates, {frames} frames"):
                data = self._data(size)
                program = jax.jit(jax.vmap(functools.partial(self._trajectory, data, frames=frames)))
                self._programs[size, frames] = program.lower(*arguments).compile()
        return self._programs[size, frames]

    def rollout(self, batch: SceneBatch, frames: int) -> Float[np.ndarray, "batch frames objects 7"]:
        """Poses (position [m], quaternion wxyz) at the start of every frame; NaN from where a candidate diverged.

        With effects on the floor, the centres of mass and the timing; those on the view are ``effects.acting.apparent``'s.

        Raises:
          InputError: an effect asks for the state in every step.
        """
        if batch.shapes != self.shapes:
            raise ValueError(f"scene kind {batch.shapes}; this simulator was made for {self.shapes}")
        if not batch.effects:
            return self._rollout(batch, frames)
        refuse_loads(batch, self.name)
        # Where no centre of mass lies beside its body's, the compiler leaves the zeros out of the mass matrix.
        simulator = self if acting.centre_of_mass(batch) is None else self._beside()
        return carried(batch, frames, lambda inside, needed, _: simulator._rollout(inside, needed))

    def launch(self, batch: SceneBatch, frames: int) -> Float[Array, "rows frames objects 7"]:
        """Poses on the device, which computes on when this returns; rows beyond the batch's repeat its last candidate.

        For scenes without effects. What has diverged is not marked.
        """
        full = padded(batch, compiled=[size for size, length in self._programs if length == frames])
        qpos, qvel = initial_state(full)
        arguments = (leaves_of(full), jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))
        return self._program(arguments, frames)(*arguments)

    def _rollout(self, batch: SceneBatch, frames: int) -> np.ndarray:
        return diverged_to_nan(np.asarray(self.launch(batch, frames), np.float64)[: len(batch)])
