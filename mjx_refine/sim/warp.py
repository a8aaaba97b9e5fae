"""MJX-Warp: MuJoCo's own algorithms as CUDA kernels, for NVIDIA GPUs."""

from __future__ import annotations

import functools
import importlib.util
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.compile_cache import compiling
from mjx_refine.effects import acting
from mjx_refine.errors import InputError
from mjx_refine.scene import Shape
from mjx_refine.sim.buckets import Launched, diverged_to_nan, rows_for
from mjx_refine.sim.carried import carried, refuse_loads
from mjx_refine.sim.model import IDLE, build_spec, contact_pairs, field_arrays, initial_state, model_fields
from mjx_refine.sim.warp_problem import REMEDY, warp_problem

if TYPE_CHECKING:
    from mjx_refine.sim.worlds import Worlds

_ITERATION_WARNINGS = (1 << 9) | (1 << 10)
"""Warp's ``OverflowType.ITERATIONS`` and ``LS_ITERATIONS``."""

KEPT = 4
"""Worlds of a scene kind that are kept."""

_POINTS = {("floor", "sphere"): 1, ("floor", "box"): 8, ("floor", "cylinder"): 4}


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
        self._mujoco.opt.disableflags |= IDLE
        self._mujoco.opt.iterations = iterations
        self._mujoco.opt.ls_iterations = ls_iterations
        self._worlds: list[Worlds] = []

    def _room(self, count: int, frames: int) -> int:
        """Candidates to make worlds for: as some have that are there, if hardly more, else a few more than ``count``."""
        return rows_for(count, [w.size for w in self._worlds if w.frames == frames])

    def _idle(self, size: int, frames: int, changed: dict[str, np.ndarray]) -> Worlds:
        """Worlds that no rollout is going on in."""
        # Imported here, because it needs Warp.
        from mjx_refine.sim.worlds import Worlds

        found = next((w for w in self._worlds if (w.size, w.frames, w.busy) == (size, frames, False)), None)
        if found is None:
            with compiling(f"MJX-Warp physics of {'+'.join(self.shapes)}, {size} candidates, {frames} frames"):
                points = contact_points(self.shapes)
                # Too few iterations in some step are no news (the solver went as far as it may); too few contacts would be.
                found = Worlds(self._mujoco, changed, size, frames, points, silent=_ITERATION_WARNINGS)
            idle = [w for w in self._worlds if not w.busy]
            for old in idle[: max(0, len(self._worlds) + 1 - KEPT)]:
                self._worlds.remove(old)
            self._worlds.append(found)
        return found

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

    def launch(self, batch: SceneBatch, frames: int) -> Launched:
        """Begins a rollout; what is returned waits for it and gives the poses on the device. Rows beyond the batch's repeat its
        last candidate.

        For scenes without effects that act on motion. What has diverged is not marked.
        """
        from mjx_refine.sim.worlds import changed_fields

        room = self._room(len(batch), frames)
        full = batch[np.minimum(np.arange(room), len(batch) - 1)]
        centre = acting.centre_of_mass(full) if full.effects else None
        fields = model_fields(full)
        changed = changed_fields(self._mujoco, field_arrays(self.shapes, fields, centre))
        worlds = self._idle(room, frames, changed)
        worlds.start(changed, fields.gravity, *initial_state(full))

        def poses() -> Float[Array, "rows frames objects 7"]:
            kept = jax.block_until_ready(jnp.array(jax.dlpack.from_dlpack(worlds.finished()), copy=True))
            worlds.busy = False
            return kept.reshape(room, frames, len(self.shapes), 7)

        return poses

    def _rollout(self, batch: SceneBatch, frames: int) -> np.ndarray:
        return diverged_to_nan(np.asarray(self.launch(batch, frames)(), np.float64)[: len(batch)])
