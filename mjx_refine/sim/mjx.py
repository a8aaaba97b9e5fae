"""MJX-JAX: rollouts that run on any device and can be differentiated."""

from __future__ import annotations

import functools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.compile_cache import compiling
from mjx_refine.effects import acting
from mjx_refine.scene import Shape
from mjx_refine.sim.buckets import Launched, bucket, diverged_to_nan
from mjx_refine.sim.carried import carried, refuse_loads
from mjx_refine.sim.colliders import installed
from mjx_refine.sim.devices import Devices
from mjx_refine.sim.leaves import Leaves, candidate_model, leaves_of
from mjx_refine.sim.mjx_import import mjx
from mjx_refine.sim.model import SUBSTEPS, build_spec, initial_state


def room(count: int, compiled: Iterable[int], multiple: int = 1) -> int:
    """The batch size for ``count`` candidates: one that is compiled if it is not over four times as large (a batch's time
    grows far less than its size), else the next bucket, rounded up to a ``multiple``."""
    fitting = [size for size in compiled if count <= size <= 4 * count]
    return min(fitting, default=-(-bucket(count) // multiple) * multiple)


def padded(batch: SceneBatch, multiple: int = 1, compiled: Iterable[int] = ()) -> SceneBatch:
    """``batch`` with its last candidate repeated up to its ``room``."""
    size = room(len(batch), compiled, multiple)
    return batch[np.minimum(np.arange(size), len(batch) - 1)]


class MjxSimulator:
    """Batched rollouts in MJX-JAX, the candidates dealt out to all devices.

    Args:
      shapes: the scene kind.
      fps: frames a second; the time step is 1 / (8 fps).
      iterations: Newton iterations a step (1 is unsound with six-dimensional contacts).
      ls_iterations: line-search iterations a Newton iteration.
      off_centre: for centres of mass that are not at the bodies' centres.
      devices: that compute; by default all local ones.
    """

    name = "mjx"

    def __init__(
        self,
        shapes: tuple[Shape, ...],
        fps: float,
        iterations: int = 20,
        ls_iterations: int = 20,
        off_centre: bool = False,
        devices: Devices | None = None,
    ):
        self.shapes = shapes
        self.fps = fps
        self.devices = devices or Devices()
        self._beside = functools.cache(lambda: MjxSimulator(shapes, fps, iterations, ls_iterations, True, self.devices))
        self.device = self.devices.name
        model = build_spec(shapes, fps, off_centre=off_centre).compile()
        # Single precision cannot reach the default of 1e-8: the solver would iterate on rounding noise, in flight too.
        model.opt.tolerance = 1e-6
        model.opt.iterations = iterations
        model.opt.ls_iterations = ls_iterations
        with installed():
            self._model = mjx.put_model(model, impl="jax")
            self._data = mjx.make_data(self._model, impl="jax")
        self._programs: dict[tuple[int, int], jax.stages.Compiled] = {}

    def trajectory(
        self, leaves: Leaves, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], frames: int
    ) -> Float[Array, "frames objects 7"]:
        """One candidate's poses, position [m] and quaternion wxyz, at the start of every frame; pure, for any transform.

        Args:
          leaves: the candidate's model fields.
          qpos: initial positions and quaternions, 7 an object.
          qvel: initial velocities, 6 an object: linear in the world's frame [m/s], angular in the body's [rad/s].
          frames: how many, static.
        """
        model = candidate_model(self._model, leaves, self.shapes)

        def substep(state, _):
            qpos, qvel, warmstart = state
            data = self._data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
            with installed():
                data = mjx.step(model, data)
            return (data.qpos, data.qvel, data.qacc_warmstart), None

        def frame(state, _):
            state, _ = jax.lax.scan(substep, state, None, length=SUBSTEPS)
            return state, state[0]

        start = (qpos, qvel, jnp.zeros_like(qvel))
        _, later = jax.lax.scan(frame, start, None, length=frames - 1)
        return jnp.concatenate([qpos[None], later]).reshape(frames, len(self.shapes), 7)

    def _program(self, arguments: tuple[Leaves, jax.Array, jax.Array], frames: int) -> jax.stages.Compiled:
        size = len(arguments[1])
        if (size, frames) not in self._programs:
            with compiling(f"MJX-JAX physics of {'+'.join(self.shapes)}, {size} candidates, {frames} frames"):
                program = jax.jit(self.devices.spread(jax.vmap(functools.partial(self.trajectory, frames=frames))))
                self._programs[size, frames] = program.lower(*arguments).compile()
        return self._programs[size, frames]

    def contact_distances(self, batch: SceneBatch) -> Float[np.ndarray, "batch contacts"]:
        """Distance of every possible contact in the first frame [m]; positive where there is none."""

        def one(leaves: Leaves, qpos: jax.Array) -> jax.Array:
            data = mjx.kinematics(candidate_model(self._model, leaves, self.shapes), self._data.replace(qpos=qpos))
            with installed():
                data = mjx.collision(candidate_model(self._model, leaves, self.shapes), data)
            return data._impl.contact.dist

        qpos, _ = initial_state(batch)
        return np.asarray(jax.jit(jax.vmap(one))(leaves_of(batch), jnp.asarray(qpos)), np.float64)

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
        """Begins a rollout; what is returned gives the poses on the device. Rows beyond the batch's repeat its last candidate.

        For scenes without effects. What has diverged is not marked.
        """
        full = padded(batch, len(self.devices), [size for size, length in self._programs if length == frames])
        qpos, qvel = initial_state(full)
        arguments = self.devices.dealt((leaves_of(full), jnp.asarray(qpos), jnp.asarray(qvel)))
        poses = self._program(arguments, frames)(*arguments)
        return lambda: poses

    def _rollout(self, batch: SceneBatch, frames: int) -> np.ndarray:
        return diverged_to_nan(np.asarray(self.launch(batch, frames)(), np.float64)[: len(batch)])
