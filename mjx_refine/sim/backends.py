"""Which engine simulates: C MuJoCo on CPUs, MJX-Warp on NVIDIA GPUs, MJX-JAX anywhere and for gradients."""

from __future__ import annotations

import os
from typing import Protocol

import numpy as np
from jaxtyping import Float

from mjx_refine.batch import SceneBatch
from mjx_refine.children import cores
from mjx_refine.effects.loading import has_loads
from mjx_refine.errors import InputError
from mjx_refine.scene import Shape
from mjx_refine.sim.carried import refuse_loads
from mjx_refine.sim.fused import LARGEST

BACKENDS = ("auto", "mjx", "warp", "mujoco")

FEW_A_CORE = 2
"""Candidates in a batch for each core below which C MuJoCo is as fast as the kernel of whole rollouts, where a few candidates
take as long as hundreds: box and cylinder, 16 cores and an H100: 128 candidates, eight on each core, 67 and 11 ms; the kernel
takes 9 for one."""

FEW_A_CORE_OF_MANY = 24
"""The same of MJX-Warp, which simulates more objects than the kernel holds."""

QUICK = (5, 4)
"""Newton and line-search iterations of MJX-Warp for a search: a batch waits for its slowest candidate. 64 candidates against C
after 0.6 s, median and nine in ten: box and cylinder 3.0 and 11 mm, with 50 and 50 iterations 2.5 and 11; four objects 11 and 34
for 6 and 28. Ten line-search iterations are no closer, four of Newton's twice as far off."""

OFFERED = "MJX_REFINE_OFFERED"
"""Environment variable: a backend that the process which searches has, where this one only prepares and finishes."""


class Simulator(Protocol):
    """What every backend offers."""

    name: str
    device: str
    shapes: tuple[Shape, ...]
    fps: float

    def rollout(self, batch: SceneBatch, frames: int) -> Float[np.ndarray, "batch frames objects 7"]:
        """Poses (position [m], quaternion wxyz) at the start of every frame; NaN from where a candidate diverged."""
        ...


class Restarting(Simulator, Protocol):
    """One that also carries objects which restart along the way: C MuJoCo."""

    def shot(
        self, batch: SceneBatch, frames: int
    ) -> tuple[Float[np.ndarray, "batch frames objects 7"], Float[np.ndarray, "batch restarts 13"]]:
        """As ``rollout``, and the states in which objects arrive where they restart; NaN where that is later."""
        ...


def resolve_backend(name: str) -> str:
    """The backend that ``name`` means here: ``auto`` is warp where Warp and an NVIDIA GPU are, else mujoco.

    Raises:
      InputError: no such backend, or warp where it cannot run.
    """
    if name not in BACKENDS:
        raise InputError(f"backend {name!r}; expected one of {', '.join(BACKENDS)}")
    if name not in ("auto", "warp"):
        return name
    if os.environ.get(OFFERED) == "warp":
        return "warp"
    from mjx_refine.sim.warp_problem import REMEDY, warp_problem

    problem = warp_problem()
    if problem and name == "warp":
        raise InputError(f"backend warp: {problem}; {REMEDY}")
    return "mujoco" if problem else "warp"


def fastest(name: str, candidates: int, objects: int) -> str:
    """The backend that ``name`` means here for so many candidates of so many objects at once: ``auto`` is mujoco also for few.

    In a process beside the one that has the GPU, warp is mujoco.

    Raises:
      InputError: no such backend, or warp where it cannot run.
    """
    resolved = resolve_backend(name)
    if resolved == "warp" == os.environ.get(OFFERED):
        return "mujoco"
    few = cores() * (FEW_A_CORE if objects <= LARGEST else FEW_A_CORE_OF_MANY)
    return "mujoco" if name == "auto" and candidates <= few else resolved


def backend_for(name: str, batch: SceneBatch) -> str:
    """The backend that ``name`` means for scenes like ``batch``: ``auto`` is mujoco where the fastest lacks an effect.

    Raises:
      InputError: no such backend, or one that cannot run here or cannot carry an effect.
    """
    resolved = resolve_backend(name)
    if resolved == "mujoco" or not has_loads(batch):
        return resolved
    if name == "auto":
        return "mujoco"
    refuse_loads(batch, resolved)
    return resolved


def make_simulator(name: str, shapes: tuple[Shape, ...], fps: float, quick: bool = False) -> Simulator:
    """A simulator of the scene kind ``shapes`` at ``fps`` frames a second.

    ``quick``: for searches, whose results C MuJoCo scores again: MJX-Warp then ends its solver earlier.

    Raises:
      InputError: no such backend, or one that cannot run here.
    """
    name = resolve_backend(name)
    # Imported here, because JAX takes a second to import and C MuJoCo does without.
    if name == "warp":
        return _warp(shapes, fps, quick)
    if name == "mjx":
        from mjx_refine.sim.mjx import MjxSimulator

        return MjxSimulator(shapes, fps)
    from mjx_refine.sim.c import MujocoSimulator

    return MujocoSimulator(shapes, fps)


def _warp(shapes: tuple[Shape, ...], fps: float, quick: bool) -> Simulator:
    """MJX-Warp, or for searches the kernel that makes all steps of a candidate, where it has room for so many objects."""
    if quick and len(shapes) <= LARGEST:
        from mjx_refine.sim.fused.simulator import FusedSimulator

        return FusedSimulator(shapes, fps)
    from mjx_refine.sim.warp import WarpSimulator

    return WarpSimulator(shapes, fps, *QUICK) if quick else WarpSimulator(shapes, fps)
