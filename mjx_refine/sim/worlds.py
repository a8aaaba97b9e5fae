"""A batch of candidates in MJX-Warp's own engine: its model, its state, and its steps recorded as CUDA graphs.

MJX calls Warp once a step and waits in JAX's only stream. Here a frame is one graph, launched in a stream of its own, so that
batches of different scene kinds share a GPU, which neither of them fills, and Python does nothing while they run.
"""

# pyright: reportInvalidTypeForm=false

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import mujoco
import numpy as np
import warp as wp

from mjx_refine.sim.cones import fast_cones
from mjx_refine.sim.mjx_import import warp_engine
from mjx_refine.sim.model import ABOVE_FLOOR, SUBSTEPS

engine = warp_engine()

AHEAD = 6
"""Frames that ``start`` asks for: a device takes so many steps at once and makes who asks for more wait."""

NOT_THERE = ("dof_M0",)
"""Names of ``field_arrays`` that MJX-Warp does without."""


def changed_fields(model: mujoco.MjModel, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """``field_arrays`` of a batch as MJX-Warp's model has them: with the rows of the floor and the world."""
    changed = {}
    for name, values in arrays.items():
        if name in ABOVE_FLOOR:
            first = np.broadcast_to(getattr(model, name)[:1], (len(values), 1, *values.shape[2:]))
            values = np.concatenate([first, values], 1)
        if name not in NOT_THERE:
            changed[name] = values.reshape(*values.shape[:2], 2, 3) if name == "geom_aabb" else values
    return changed


class Worlds:
    """``size`` candidates of a model and their trajectories.

    Args:
      model: of the scene kind.
      batched: names of the model's arrays of which every candidate has its own.
      size: candidates.
      frames: of a trajectory.
      contacts: the most that a candidate can have.
      silent: bits of ``warn_overflow`` that are no news.
    """

    def __init__(
        self, model: mujoco.MjModel, batched: Iterable[str], size: int, frames: int, contacts: int, silent: int = 0
    ):
        self.size, self.frames = size, frames
        self.busy = False
        """Whether a rollout has begun whose poses nobody has taken: not to be started again."""
        self._left = 0
        self.device = wp.get_device()
        self._stream = wp.Stream(self.device) if self.device.is_cuda else None
        with self._here():
            self._model = engine.put_model(model, dict.fromkeys(batched, size))
            self._model.opt.gravity = wp.zeros(size, dtype=wp.vec3)
            # As MJX has it. (Whether conditional graphs would be quicker was not measured.)
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
        """Begins a rollout; ``finished`` goes on with it and waits.

        Args:
          changed: of ``changed_fields``, ``size`` rows each.
          gravity: (size, 3) [m/s^2].
          qpos, qvel: (size, nq), (size, nv).
        """
        self.busy = True
        self._run[0]()
        for name, values in changed.items():
            self._put(getattr(self._model, name), values)
        self._put(self._model.opt.gravity, gravity)
        self._put(self._data.qpos, qpos)
        self._put(self._data.qvel, qvel)
        self._keep_first()
        self._left = self.frames - 1
        self._go_on(AHEAD)

    def _go_on(self, frames: int) -> None:
        frames = min(frames, self._left)
        self._left -= frames
        for _ in range(frames):
            self._run[1]()

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
        self._go_on(self._left)
        if self._stream is not None:
            wp.synchronize_stream(self._stream)
        return self._poses


def _arrays(group: Any) -> Iterator[wp.array]:
    """All arrays of a state, those of its parts as well, each once."""
    seen: set[int] = set()

    def within(one: Any) -> Iterator[wp.array]:
        if isinstance(one, wp.array):
            if one.size and one.ptr is not None and one.ptr not in seen:
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
    world, k = wp.tid()  # pyright: ignore
    poses[world, frame[0], k] = qpos[world, k]
