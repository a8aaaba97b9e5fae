"""Which derivatives least squares uses, and whether any can be trusted on a clip."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import jax
import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.errors import InputError
from mjx_refine.gradients import DerivativeError, check
from mjx_refine.gradients.check import Method, Verdict
from mjx_refine.gradients.tangents import kinked
from mjx_refine.search.features import DIRECTIONS
from mjx_refine.search.problem import Problem, Start
from mjx_refine.space import Space

if TYPE_CHECKING:
    from mjx_refine.gradients import Differentiator
    from mjx_refine.sim.c import MujocoSimulator
    from mjx_refine.sim.mjx import MjxSimulator

WORK = 40_000
"""Rollouts x frames x objects that a check may take: half a second of C MuJoCo on two cores."""

LEAST_PARAMETERS = 12
"""Parameters that a check looks at however long the clip is; the clip is cut before."""

UNCOMPILED = (InputError, jax.errors.JaxRuntimeError)
"""Another MJX than the derivatives were written for; XLA without enough memory."""

Columns = tuple[Float[np.ndarray, "columns frames objects features"], Bool[np.ndarray, "dimension"]]
"""Derivatives of outlines, then of flow [px per prior width], of the parameters that the mask says."""


@dataclasses.dataclass(frozen=True)
class Derivatives:
    """Which derivatives can be trusted on a clip.

    Attributes:
      method: ``autodiff``; ``differences`` (of rollouts); ``population`` (none).
      reason: a sentence.
      until: frame from which they cannot.
    """

    method: Method
    reason: str
    until: int


class Automatic:
    """Derivatives of what least squares compares, through MJX-JAX.

    Args:
      differentiator: of the space that least squares searches.
      message: told once why differences had to step in.
    """

    def __init__(self, differentiator: Differentiator, message: Callable[[str], None]):
        self.differentiator, self.message = differentiator, message
        self._told = self._broken = False

    def __call__(
        self, point: np.ndarray, frames: int, image: tuple[int, int], pixels: np.ndarray | None
    ) -> Columns | None:
        """Derivatives at ``point``; without those parameters in which the scene has a kink there.

        Args:
          point: in the unit box.
          frames: how many.
          image: (width, height) [px].
          pixels: where flow is compared (frames, objects, points, 2) [px]; None for outlines alone.

        Returns:
          None where they are not finite, or their program cannot be compiled.
        """
        if self._broken:
            return None
        space = self.differentiator.space
        try:
            slopes = self.differentiator.outlines(point, frames, image, DIRECTIONS)[1]
            if pixels is not None:
                moved = self.differentiator.flow(point, frames, pixels, image)[1]
                slopes = np.concatenate([slopes, moved.reshape(*moved.shape[:3], -1)], -1)
        except (DerivativeError, *UNCOMPILED) as error:
            if not self._told:
                self.message(f"differences instead of automatic derivatives: {_first_line(error)}")
            # What is not finite here may be elsewhere; what does not compile never will.
            self._told, self._broken = True, isinstance(error, UNCOMPILED)
            return None
        held = ~kinked(space, point)
        return slopes[held] * space.sigma[held, None, None, None], held


@functools.lru_cache(maxsize=4)
def _simulator(shapes, fps: float) -> MjxSimulator:
    """The same object for the same scene kind: its programs take a minute to compile."""
    from mjx_refine.sim.mjx import MjxSimulator

    return MjxSimulator(shapes, fps)


class DerivativeChoice:
    """Derivatives as the options ask for them, where they can be trusted.

    Args:
      problem: samples, observation and options.
      message: tells the user what was chosen.
    """

    def __init__(self, problem: Problem, message: Callable[[str], None]):
        self.problem, self.options, self.message = problem, problem.options, message

    def automatic(self, start: Start, space: Space) -> Automatic | None:
        """What a landing from ``start`` uses beside differences; None for differences alone."""
        if self.options.derivatives != "autodiff":
            return None
        if start.given.effects:
            self.message(f"landing from sample {start.index} by differences: automatic ones know nothing of effects")
            return None
        told = self.judge(start, space, space.start)
        if told.method != "autodiff":
            self.message(f"landing from sample {start.index} by differences: {told.reason}")
            return None
        return Automatic(self._differentiator(space), self.message)

    def judge(self, start: Start, space: Space, point: Float[np.ndarray, "dimension"]) -> Derivatives:
        """Whether derivatives at ``point`` tell what is around it; automatic ones only if they were asked for."""
        key = ("derivatives", start.index, point.tobytes())
        if key not in self.problem.kept:
            self.problem.kept[key] = self._judged(start, space, point)
        return self.problem.kept[key]

    def _judged(self, start: Start, space: Space, point: Float[np.ndarray, "dimension"]) -> Derivatives:
        length, simulator = (
            self.problem.observation.length,
            cast("MujocoSimulator", self.problem.as_seen(start.scene.shapes)),
        )
        frames, most = extent(length, space)
        compare = functools.partial(
            check, space, point, frames, self.problem.observation.size, simulator.fps, simulator=simulator, most=most
        )
        told, problem = self._compared(compare, space)
        reason = told.reason + problem
        if most < space.dimension:
            reason += f"; {most} of {space.dimension} parameters were looked at"
        if frames < length:
            reason += f"; the first {frames} of {length} frames were looked at"
        until = (
            told.differences_part if told.autodiff_parts is None else max(told.differences_part, told.autodiff_parts)
        )
        return Derivatives(told.method, reason, until)

    def final(self, start: Start, space: Space, point: Float[np.ndarray, "dimension"]) -> Derivatives:
        """``judge`` where the landings ended, and a warning to whoever goes by derivatives alone without cause."""
        told = self.judge(start, space, point)
        if told.method == "population" and self.options.optimizer == "gradient":
            self.message(
                f"derivatives cannot be trusted on this clip after frame {told.until}: {told.reason}; "
                "--optimizer hybrid is the better choice"
            )
        return told

    def _compared(self, compare: Callable[..., Verdict], space: Space) -> tuple[Verdict, str]:
        if self.options.derivatives == "autodiff" and not space.scene.effects:
            try:
                return compare(autodiff=self._differentiator(space)), ""
            except UNCOMPILED as error:
                return compare(), f"; automatic ones cannot be compiled: {_first_line(error)}"
        return compare(), ""

    def _differentiator(self, space: Space) -> Differentiator:
        from mjx_refine.gradients import Differentiator

        observation = self.problem.observation
        simulator = _simulator(space.scene.shapes, observation.fps)
        return Differentiator(space, simulator, frames=observation.length)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0]


def extent(length: int, space: Space) -> tuple[int, int]:
    """(frames, parameters) that a check of two widths of differences looks at, to stay within ``WORK``."""
    objects = len(space.scene.shapes)
    most = max(LEAST_PARAMETERS, (WORK // (objects * length) - 2) // 4)
    most = min(most, space.dimension)
    return min(length, max(2, WORK // (objects * (4 * most + 2)))), most
