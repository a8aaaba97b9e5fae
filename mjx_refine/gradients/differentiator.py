"""Derivatives of rollouts and of what a camera sees of them, by automatic differentiation of MJX-JAX.

A point of the unit box becomes a scene in closed form, in numpy; that part's derivatives are differences in double
precision (``tangents``). They are pushed forward through physics and view by JAX, or a loss's derivatives pulled back.
"""

from __future__ import annotations

import contextlib
import functools
import weakref
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.compile_cache import compiling
from mjx_refine.gradients.finite import require_finite
from mjx_refine.gradients.steps import differentiable_steps
from mjx_refine.gradients.tangents import Inputs, tangents
from mjx_refine.gradients.views import flow_view, outline_view, poses_view
from mjx_refine.sim.mjx import MjxSimulator
from mjx_refine.space import Space

View = Callable[..., Any]
"""A JAX function of (poses (T, N, 7), size (N, 3), camera_position (3,), camera_pitch (), camera_fovy (), *data)."""

CHUNK = 16
"""Tangents that are pushed through one rollout at a time."""

PROGRAMS = 32
"""Compiled programs that are kept."""

HORIZONS = (1, 8, 16, 32, 64)
"""Lengths [frames] that physics is compiled for; beyond, multiples of the last."""


def compiler_options() -> dict[str, str | bool]:
    """How XLA compiles derivatives. On a CPU, its small matrix products are slower by 5 to 40 times in several threads."""
    return {"xla_cpu_multi_thread_eigen": False} if jax.default_backend() == "cpu" else {}


def _trajectory(simulator: MjxSimulator, frames: int, inputs: Inputs) -> Array:
    """One candidate's poses. Friction has C MuJoCo's floor: MJX's own is 1e-15, and its square drowns in float32."""
    friction = jnp.maximum(inputs.leaves.pair_friction, mujoco.mjMINMU)
    leaves = inputs.leaves._replace(pair_friction=friction)
    return simulator.trajectory(leaves, inputs.qpos, inputs.qvel, frames)


def push(simulator: MjxSimulator, frames: int, inputs: Inputs, moves: Inputs) -> tuple[Array, Array]:
    """One candidate's poses and their derivatives along each of ``moves`` (leading axis); pure, for any transform."""

    trajectory = functools.partial(_trajectory, simulator, frames)
    with differentiable_steps():
        return jax.vmap(lambda move: jax.jvp(trajectory, (inputs,), (move,)), out_axes=(None, 0))(moves)


def pull(simulator: MjxSimulator, frames: int, loss: View, inputs: Inputs, data: tuple) -> tuple[Array, Inputs]:
    """(loss, its derivatives in the inputs), by reverse mode; pure."""

    def value(values: Inputs) -> Array:
        return loss(_trajectory(simulator, frames, values), *_rest(values), *data)

    with differentiable_steps():
        return jax.value_and_grad(value)(inputs)


def _rest(inputs: Inputs) -> tuple:
    """What a view takes besides the poses."""
    return inputs.size, inputs.camera_position, inputs.camera_pitch, inputs.camera_fovy


def look(view: View, arrays: tuple, moves: tuple, data: tuple) -> tuple[Array, Array]:
    """A view's value and its derivatives along each of ``moves``."""

    def value(*values) -> Array:
        return view(*values, *data)

    return jax.vmap(lambda *move: jax.jvp(value, arrays, move), out_axes=(None, 0))(*moves)


def horizon(frames: int) -> int:
    """How many frames the program for ``frames`` computes: few lengths are ever compiled."""
    return next((length for length in HORIZONS if length >= frames), -(-frames // 64) * 64)


# Spaces around other scenes of the kind, or with frozen parameters, run the same programs.
_PROGRAMS: weakref.WeakKeyDictionary[MjxSimulator, dict[tuple, Any]] = weakref.WeakKeyDictionary()


class Differentiator:
    """Derivatives in the coordinates of the unit box.

    Physics is compiled once for a length of rollout, in 20 to 100 s on a CPU, and serves every view; a reverse
    derivative is compiled for every loss.

    Args:
      space: the parameters.
      simulator: of the same scene kind.
      chunk: how many tangents share a rollout; fewer need less memory (the rest of the last chunk
        is filled up).
      frames: rollouts are computed for at least so many: one program then serves every shorter horizon.

    Raises:
      ValueError: the simulator is for another scene kind.
    """

    def __init__(self, space: Space, simulator: MjxSimulator, chunk: int = CHUNK, frames: int = 1):
        if space.scene.shapes != simulator.shapes:
            raise ValueError(f"scene kind {space.scene.shapes}; this simulator was made for {simulator.shapes}")
        self.space = space
        self.simulator = simulator
        self.chunk = chunk
        self.frames = frames
        self._programs = _PROGRAMS.setdefault(simulator, {})
        self._last: tuple[tuple, tuple[Inputs, Inputs, np.ndarray, np.ndarray]] | None = None

    def poses(
        self, point: Float[np.ndarray, "dimension"], frames: int
    ) -> tuple[Float[np.ndarray, "frames objects 7"], Float[np.ndarray, "dimension frames objects 7"]]:
        """Poses (position [m], quaternion wxyz) at every frame and their derivatives.

        Raises:
          DerivativeError: the rollout or a derivative is not finite.
        """
        return self.jacobian(point, frames, poses_view)

    def outlines(
        self, point: Float[np.ndarray, "dimension"], frames: int, image: tuple[int, int], directions: int = 16
    ) -> tuple[
        Float[np.ndarray, "frames objects directions"], Float[np.ndarray, "dimension frames objects directions"]
    ]:
        """How far each silhouette reaches in evenly spaced directions of the image [px], and the derivatives.

        ``image`` is (width, height) [px].

        Raises:
          DerivativeError: the rollout or a derivative is not finite.
        """
        return self._frame_by_frame(point, frames, outline_view(self.simulator.shapes, image, directions))

    def flow(
        self,
        point: Float[np.ndarray, "dimension"],
        frames: int,
        pixels: Float[np.ndarray, "frames objects points 2"],
        image: tuple[int, int],
    ) -> tuple[Float[np.ndarray, "frames objects points 2"], Float[np.ndarray, "dimension frames objects points 2"]]:
        """Flow [px/frame] of each object's surface seen at ``pixels`` (``view.points``), and the derivatives.

        Raises:
          DerivativeError: the rollout or a derivative is not finite.
        """
        view = flow_view(self.simulator.shapes, image)
        return self._frame_by_frame(point, frames, view, np.asarray(pixels[:frames], np.float64))

    def jacobian(self, point: Float[np.ndarray, "dimension"], frames: int, function: View, *data: Array | np.ndarray):
        """Value of ``function`` and its derivatives (leading axis ``dimension``), by forward mode.

        Args:
          point: in the unit box.
          frames: how many.
          function: a ``View`` that returns one array. Pass the same object again and its program is not compiled again.
          data: arrays that it gets too, without derivatives; they may change between calls.

        Raises:
          DerivativeError: the value or a derivative is not finite.
          ValueError: the point lies outside of the box.
        """
        inputs, moves, poses, slopes = self._rollout(point, frames)
        if function is poses_view:
            return poses, slopes
        return self._look(inputs, moves, poses, slopes, function, data)

    def _frame_by_frame(self, point: np.ndarray, frames: int, function: View, *data: np.ndarray):
        """``jacobian`` of a view, and of data, that have a row for each frame: all horizons share a program."""
        inputs, moves, poses, slopes = self._rollout(point, frames)
        beyond = max(horizon(self.frames) - frames, 0) if self.frames > 1 else 0
        # The last frame again: whatever the rollout does beyond the horizon has no say.
        poses, *rows = (np.concatenate([a, np.repeat(a[-1:], beyond, 0)]) for a in (poses, *data))
        slopes = np.concatenate([slopes, np.repeat(slopes[:, -1:], beyond, 1)], 1)
        value, columns = self._look(inputs, moves, poses, slopes, function, rows)
        return value[:frames], columns[:, :frames]

    def _look(self, inputs: Inputs, moves: Inputs, poses, slopes, function: View, data):
        arrays = ((poses, *_rest(inputs)), (slopes, *_rest(moves)), tuple(data))
        arguments = jax.tree.map(jnp.asarray, arrays)
        key = ("view", function)
        value, columns = self._run(None, key, functools.partial(look, function), arguments)
        value, columns = np.asarray(value, np.float64), np.asarray(columns, np.float64)
        require_finite(value, columns, self.space.names)
        return value, columns

    def _rollout(self, point: np.ndarray, frames: int) -> tuple[Inputs, Inputs, np.ndarray, np.ndarray]:
        """(inputs, their tangents, poses, slopes) of ``frames`` frames, all finite."""
        inputs, moves, poses, slopes = self._pushed(point, horizon(max(frames, self.frames)))
        poses, slopes = poses[:frames], slopes[:, :frames]
        require_finite(poses, slopes, self.space.names)
        return inputs, moves, poses, slopes

    def _pushed(self, point: np.ndarray, length: int) -> tuple[Inputs, Inputs, np.ndarray, np.ndarray]:
        """``_rollout`` of a length that is compiled, finite or not; the last point's is kept."""
        key = (np.asarray(point, np.float64).tobytes(), length)
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        inputs, moves = tangents(self.space, point)
        count = self.space.dimension
        short = -count % self.chunk
        # Tangents of zero fill the last chunk.
        filled = jax.tree.map(lambda a: np.concatenate([a, np.zeros((short, *a.shape[1:]))]), moves)
        device, filled = jax.tree.map(jnp.asarray, (inputs, filled))
        body = functools.partial(push, self.simulator, length)
        what = f"derivatives of MJX-JAX rollouts of {'+'.join(self.simulator.shapes)}, {length} frames"
        poses, columns = None, []
        for first in range(0, count, self.chunk):
            part = jax.tree.map(lambda a, first=first: a[first : first + self.chunk], filled)
            poses, slopes = self._run(what, ("forward", length, self.chunk), body, (device, part))
            columns.append(np.asarray(slopes, np.float64))
        result = (inputs, moves, np.asarray(poses, np.float64), np.concatenate(columns)[:count])
        self._last = (key, result)
        return result

    def gradient(
        self, point: Float[np.ndarray, "dimension"], frames: int, loss: View, *data: Array | np.ndarray
    ) -> tuple[float, Float[np.ndarray, "dimension"]]:
        """Value and derivatives of ``loss``, a ``View`` that returns one number, by reverse mode.

        Raises:
          DerivativeError: the value or a derivative is not finite.
          ValueError: the point lies outside of the box.
        """
        inputs, moves = tangents(self.space, point)
        arguments = jax.tree.map(jnp.asarray, (inputs, data))
        body = functools.partial(pull, self.simulator, frames, loss)
        what = f"reverse derivatives of MJX-JAX rollouts of {'+'.join(self.simulator.shapes)}, {frames} frames"
        value, pulled = self._run(what, ("reverse", loss, frames), body, arguments)
        pairs = zip(jax.tree.leaves(pulled), jax.tree.leaves(moves), strict=True)
        total = np.zeros(self.space.dimension)
        for cotangent, move in pairs:
            rows = move.reshape(len(total), -1)
            # What does not move is left out: its cotangent may be anything.
            total += np.where(rows != 0, rows * np.asarray(cotangent, np.float64).reshape(-1), 0.0).sum(1)
        require_finite(np.asarray(value), total, self.space.names)
        return float(value), total

    def _run(self, what: str | None, key: tuple, body: Callable, arguments: tuple):
        shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(arguments))
        key = (*key, shapes)
        if key not in self._programs:
            while len(self._programs) >= PROGRAMS:
                del self._programs[next(iter(self._programs))]
            # Views compile in a second or two: nothing to announce.
            with compiling(what) if what else contextlib.nullcontext():
                self._programs[key] = jax.jit(body).lower(*arguments).compile(compiler_options())
        return self._programs[key](*arguments)
