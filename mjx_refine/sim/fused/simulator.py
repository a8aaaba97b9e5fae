"""Batched rollouts by the kernel that simulates a candidate from its first frame to its last."""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp
from jaxtyping import Array, Float, Int

from mjx_refine.batch import SceneBatch
from mjx_refine.compile_cache import compiling
from mjx_refine.effects import acting
from mjx_refine.errors import InputError
from mjx_refine.rotations import rotate
from mjx_refine.scene import Shape
from mjx_refine.sim.buckets import Launched, diverged_to_nan, rows_for
from mjx_refine.sim.carried import carried, refuse_loads
from mjx_refine.sim.fused import LARGEST
from mjx_refine.sim.fused.kernel import CONVEX, LANES, kernel
from mjx_refine.sim.model import SUBSTEPS, contact_pairs, initial_state, model_fields
from mjx_refine.sim.warp_problem import REMEDY, warp_problem

_SHAPES = {"sphere": 0, "cylinder": 1, "box": 2}

_POINTS = {0: 1, 1: 4, 2: 4, 3: 1, 6: 1, 7: 4, 9: 1, 10: 4, 11: 8}
"""Points at most where a pair of each kind touches: with the floor 0 sphere, 1 cylinder, 2 box; else 3 + first + 3 second."""


def plan(shapes: tuple[Shape, ...]) -> tuple[Int[np.ndarray, "pairs 4"], int]:
    """A row a pair (first object or -1, second, kind, first point), and how many points there are."""
    rows, points = [], 0
    for first, second in contact_pairs(len(shapes)):
        if first < 0:
            kind = _SHAPES[shapes[second]]
        else:
            first, second = sorted((first, second), key=lambda i: _SHAPES[shapes[i]])
            kind = 3 + _SHAPES[shapes[first]] + 3 * _SHAPES[shapes[second]]
        rows.append((first, second, kind, points))
        points += _POINTS[kind]
    return np.array(rows, np.int32), points


def packed(batch: SceneBatch) -> Float[np.ndarray, "batch numbers"]:
    """What the kernel reads of every candidate: gravity, 21 numbers a body, 6 a pair of ``contact_pairs``."""
    fields = model_fields(batch)
    count, bodies = batch.position.shape[:2]
    qpos, qvel = (a.reshape(count, bodies, -1) for a in initial_state(batch))
    turning = rotate(qpos[..., 3:], qvel[..., 3:])
    body = [
        fields.geom_size,
        fields.body_mass[..., None],
        fields.body_inertia,
        fields.body_invweight0[..., :1],
        qpos,
        qvel[..., :3],
        turning,
    ]
    pair = [
        fields.pair_friction[..., [0, 2, 3]],
        -fields.pair_solref[..., :1],
        -fields.pair_solref[..., 1:],
        -fields.pair_solreffriction[..., 1:],
    ]
    parts = [np.concatenate(group, -1).reshape(count, -1) for group in (body, pair)]
    return np.concatenate([fields.gravity, *parts], 1).astype(np.float32)


class FusedSimulator:
    """Batched rollouts, a warp of the GPU a candidate. For searches: in single precision, with contact points of our own.

    Args:
      shapes: the scene kind, up to ``LARGEST`` objects.
      fps: frames a second; the time step is 1 / (8 fps).
      any_device: also run on a CPU (a lane a candidate, slow; for tests).

    Raises:
      InputError: Warp is not installed, there is no NVIDIA GPU, or the scene has too many objects.
    """

    name = "warp"

    def __init__(self, shapes: tuple[Shape, ...], fps: float, any_device: bool = False):
        problem = warp_problem()
        if problem and not (any_device and importlib.util.find_spec("warp")):
            raise InputError(f"backend warp: {problem}; {REMEDY}")
        if len(shapes) > LARGEST:
            raise InputError(f"{len(shapes)} objects; one kernel holds up to {LARGEST}")
        self.shapes, self.fps = shapes, fps
        self.device = jax.devices()[0].device_kind
        self._on = wp.get_device()
        self._stream = wp.Stream(self._on) if self._on.is_cuda else None
        rows, self._points = plan(shapes)
        self._kinds = frozenset(int(kind) for kind in rows[:, 2]) & frozenset(CONVEX.values())
        self._plan = wp.array(rows.reshape(-1), dtype=int, device=self._on)
        self._sizes: set[int] = set()

    @functools.cached_property
    def _kernel(self) -> Any:
        made = kernel(len(self.shapes), self._points, self._kinds)
        with compiling(f"the kernel of {len(self.shapes)} objects"):
            made.module.load(self._on, self._lanes)
        return made

    @property
    def _lanes(self) -> int:
        return LANES if self._on.is_cuda else 1

    def launch(self, batch: SceneBatch, frames: int) -> Launched:
        """Begins a rollout; what is returned waits for it and gives the poses on the device. Rows beyond the batch's repeat its
        last candidate.

        For scenes without effects that act on motion. What has diverged is not marked.
        """
        waited = self._begun(batch, frames)

        def finished() -> Float[Array, "rows frames objects 7"]:
            kept = jax.block_until_ready(jnp.array(jax.dlpack.from_dlpack(waited()), copy=True))
            return kept.reshape(-1, frames, len(self.shapes), 7)

        return finished

    def _begun(self, batch: SceneBatch, frames: int) -> Callable[[], Any]:
        """Begins a rollout; what is returned waits for it and gives the poses, an array of Warp's, flat."""
        if batch.shapes != self.shapes:
            raise ValueError(f"scene kind {batch.shapes}; this simulator was made for {self.shapes}")
        rows = rows_for(len(batch), self._sizes)
        self._sizes.add(rows)
        numbers = packed(batch)
        numbers = numbers[np.minimum(np.arange(rows), len(batch) - 1)]
        poses = wp.empty(rows * frames * 7 * len(self.shapes), dtype=float, device=self._on)
        device = wp.array(numbers.reshape(-1), dtype=float, device=self._on)
        inputs = [device, numbers.shape[1], self._plan, frames, 1.0 / (self.fps * SUBSTEPS), poses]
        made = self._kernel
        # What was copied on Warp's own stream is there before the kernel begins.
        if self._stream is not None:
            self._stream.wait_stream(self._on.stream)
        wp.launch(made, rows * self._lanes, inputs=inputs, device=self._on, stream=self._stream, block_dim=self._lanes)

        def waited() -> Any:
            if self._stream is not None:
                wp.synchronize_stream(self._stream)
            # What the kernel reads is not given to another rollout before that.
            del inputs[:]
            return poses

        return waited

    def rollout(self, batch: SceneBatch, frames: int) -> Float[np.ndarray, "batch frames objects 7"]:
        """Poses (position [m], quaternion wxyz) at the start of every frame; NaN from where a candidate diverged.

        With effects on the floor and the timing; those on the view are ``effects.acting.apparent``'s.

        Raises:
          InputError: an effect asks for the state in every step.
        """
        if not batch.effects:
            return self._rollout(batch, frames)
        refuse_loads(batch, self.name)
        if acting.centre_of_mass(batch) is not None:
            return self._beside.rollout(batch, frames)
        return carried(batch, frames, lambda inside, needed, _: self._rollout(inside, needed))

    @functools.cached_property
    def _beside(self) -> Any:
        """MJX-Warp, for centres of mass that lie beside the bodies' centres."""
        from mjx_refine.sim.warp import WarpSimulator

        return WarpSimulator(self.shapes, self.fps, any_device=not self._on.is_cuda)

    def _rollout(self, batch: SceneBatch, frames: int) -> np.ndarray:
        poses = self._begun(batch, frames)().numpy().reshape(-1, frames, len(self.shapes), 7)
        return diverged_to_nan(poses[: len(batch)].astype(np.float64))
