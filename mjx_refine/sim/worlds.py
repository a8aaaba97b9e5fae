"""A batch of candidates in MJX-Warp's own engine: its model, its state, and its steps recorded as CUDA graphs.

MJX calls Warp once a step and waits in JAX's only stream. Here a frame is one graph, launched in a stream of its own, so that
batches of different scene kinds share a GPU, which neither of them fills, and Python does nothing while they run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
import warp as wp
from jaxtyping import Float

from mjx_refine.scene import Shape
from mjx_refine.sim.cones import fast_cones
from mjx_refine.sim.mjx_import import warp_engine
from mjx_refine.sim.model import SUBSTEPS, ModelFields, half_extents

engine = warp_engine()

BATCHED = (
    "geom_size",
    "geom_rbound",
    "geom_aabb",
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_invweight0",
    "dof_invweight0",
    "pair_friction",
    "pair_solref",
    "pair_solreffriction",
)
"""Fields of the model of which every candidate has its own."""


def changed_fields(
    model: mujoco.MjModel,
    shapes: tuple[Shape, ...],
    fields: ModelFields,
    centre_of_mass: Float[np.ndarray, "batch objects 3"] | None = None,
) -> dict[str, np.ndarray]:
    """Arrays of a batch by the names of the model's fields, with a leading axis; the floor and the world stay as they are."""

    def below(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        return np.concatenate([np.broadcast_to(old[:1], (len(new), 1, *old.shape[1:])), new], 1)

    mass, weight = fields.body_mass, fields.body_invweight0
    half = half_extents(shapes, fields.geom_size)
    boxes = np.stack([np.zeros_like(half), half], 2)
    changed = {
        "geom_size": below(model.geom_size, fields.geom_size),
        "geom_rbound": below(model.geom_rbound, fields.geom_rbound),
        "geom_aabb": below(model.geom_aabb.reshape(-1, 2, 3), boxes),
        "body_mass": below(model.body_mass, mass),
        "body_subtreemass": np.concatenate([mass.sum(1, keepdims=True), mass], 1),
        "body_inertia": below(model.body_inertia, fields.body_inertia),
        "body_invweight0": below(model.body_invweight0, weight),
        "dof_invweight0": np.repeat(weight, 3, axis=-1).reshape(len(weight), -1),
        "pair_friction": fields.pair_friction,
        "pair_solref": fields.pair_solref,
        "pair_solreffriction": fields.pair_solreffriction,
    }
    if centre_of_mass is not None:
        changed["body_ipos"] = below(model.body_ipos, centre_of_mass)
    return changed


class Worlds:
    """``size`` candidates of a model and their trajectories.

    Args:
      model: of the scene kind.
      size: candidates.
      frames: of a trajectory.
      contacts: the most that a candidate can have.
      off_centre: whether candidates have their own centres of mass.
      silent: bits of ``warn_overflow`` that are no news.
    """

    def __init__(
        self, model: mujoco.MjModel, size: int, frames: int, contacts: int, off_centre: bool = False, silent: int = 0
    ):
        self.size, self.frames = size, frames
        self.device = wp.get_device()
        self._stream = wp.Stream(self.device) if self.device.is_cuda else None
        batched = (*BATCHED, "body_ipos") if off_centre else BATCHED
        with self._here():
            self._model = engine.put_model(model, dict.fromkeys(batched, size))
            self._model.opt.gravity = wp.zeros(size, dtype=wp.vec3)
            # Conditional graphs end with the last world's last iteration: with thousands of worlds that is the bound.
            self._model.opt.graph_conditional = False
            self._model.opt.warn_overflow &= ~silent
            # One list of contacts for all candidates, and constraint rows for each: six a contact.
            self._data = engine.make_data(model, size, naconmax=size * contacts, njmax=6 * contacts)
            self._fresh = [(array, wp.clone(array)) for array in _arrays(self._data)]
            self._frame = wp.zeros(1, dtype=int)
            self._poses = wp.zeros((size, frames, model.nq), dtype=float)
            self._run = self._recorded()

    def _here(self) -> Any:
        return wp.ScopedStream(self._stream) if self._stream is not None else wp.ScopedDevice(self.device)

    def _begin(self) -> None:
        """Nothing of an earlier rollout stays, since a diverged world's NaN would."""
        for array, fresh in self._fresh:
            wp.copy(array, fresh)
        self._frame.zero_()

    def _advance(self) -> None:
        with fast_cones():
            for _ in range(SUBSTEPS):
                engine.step(self._model, self._data)
        wp.launch(_next, 1, inputs=[self._frame])
        wp.launch(_keep, self._data.qpos.shape, inputs=[self._frame, self._data.qpos, self._poses])

    def _recorded(self) -> tuple[Callable[[], None], Callable[[], None]]:
        """What empties the state, and what computes a frame."""
        if self._stream is None:
            return self._begin, self._advance
        self._begin()
        self._advance()  # compiles and loads all kernels, which a recording may not
        graphs = []
        for what in (self._begin, self._advance):
            with wp.ScopedCapture(stream=self._stream) as capture:
                what()
            graphs.append(capture.graph)
        begin, advance = graphs
        return (
            lambda: wp.capture_launch(begin, stream=self._stream),
            lambda: wp.capture_launch(advance, stream=self._stream),
        )

    def start(self, changed: dict[str, np.ndarray], gravity: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Begins a rollout; ``finished`` waits for it.

        Args:
          changed: of ``changed_fields``, ``size`` rows.
          gravity: (size, 3) [m/s^2].
          qpos, qvel: (size, nq), (size, nv).
        """
        begin, advance = self._run
        begin()
        for name, values in changed.items():
            self._put(getattr(self._model, name), values)
        self._put(self._model.opt.gravity, gravity)
        self._put(self._data.qpos, qpos)
        self._put(self._data.qvel, qvel)
        self._keep_first()
        for _ in range(self.frames - 1):
            advance()

    def _keep_first(self) -> None:
        shape, inputs = self._data.qpos.shape, [self._frame, self._data.qpos, self._poses]
        wp.launch(_keep, shape, inputs=inputs, device=self.device, stream=self._stream)

    def _put(self, array: wp.array, values: np.ndarray) -> None:
        # The host's memory is read before the copy returns.
        wp.copy(
            array,
            wp.array(np.ascontiguousarray(values, np.float32), dtype=array.dtype, device="cpu"),
            stream=self._stream,
        )

    def finished(self) -> wp.array:
        """(size, frames, nq) on the device, until the next ``start``; waits without holding Python's lock."""
        if self._stream is not None:
            wp.synchronize_stream(self._stream)
        return self._poses


def _arrays(group: Any) -> Iterator[wp.array]:
    """All arrays of a state, those of its parts as well, each once."""
    seen: set[int] = set()

    def within(one: Any) -> Iterator[wp.array]:
        if isinstance(one, wp.array):
            if one.size and one.ptr not in seen:
                seen.add(one.ptr)
                yield one
        elif dataclasses.is_dataclass(one):
            for field in dataclasses.fields(one):
                yield from within(getattr(one, field.name))
        elif isinstance(one, tuple | list):
            for part in one:
                yield from within(part)

    yield from within(group)


@wp.kernel
def _next(frame: wp.array(dtype=int)):
    frame[0] = frame[0] + 1


@wp.kernel
def _keep(frame: wp.array(dtype=int), qpos: wp.array2d(dtype=float), poses: wp.array3d(dtype=float)):
    world, k = wp.tid()
    poses[world, frame[0], k] = qpos[world, k]
