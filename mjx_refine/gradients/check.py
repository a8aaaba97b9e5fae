"""Whether derivatives mean anything at a point of a scene's parameter space, and which kind to use there.

A contact makes the landscape jagged: then differences of different steps disagree with each other, and the derivative
at the point, however exact, says nothing about its surroundings. So derivatives are compared with differences of C
MuJoCo's double precision at three widths, frame by frame, on what a camera sees.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float, Int

from mjx_refine.gradients.finite import DerivativeError
from mjx_refine.gradients.tangents import kinked, stencil
from mjx_refine.gradients.views import precise_outlines
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.space import Space

if TYPE_CHECKING:
    from mjx_refine.gradients.differentiator import Differentiator

STEPS = (1e-1, 1e-2, 1e-3)
"""Widths of the differences, in prior standard deviations, from wide to narrow."""

ALIKE = 0.9
"""Cosine between two derivatives of a frame above which they are said to agree."""

ENOUGH = 0.5
"""Part of the clip over which derivatives must hold for a search to use them."""

DIRECTIONS = 16

NAMED = 4
"""Parameters without a derivative that a verdict's reason names."""

Method = Literal["autodiff", "differences", "population"]


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Which derivatives to use, and why.

    Attributes:
      method: ``autodiff``; ``differences`` (of rollouts, at 0.01 to 0.1 prior widths); ``population`` (none at all).
      reason: a sentence for the user.
      autodiff: cosine between automatic derivatives and the narrower two differences, the lesser, frame by frame;
        None where they were not asked for or are not finite.
      narrow: cosine between differences of 0.01 and 0.001 prior widths; None where automatic ones were not asked for.
      wide: cosine between differences of 0.1 and 0.01 prior widths.
      autodiff_parts: first frame from which automatic derivatives disagree; the number of frames where they never do.
      differences_part: first frame from which the wide differences disagree; ditto.
      kinks: parameters in which the scene itself has no derivative at this point (a flat box rises whichever way it is
        tilted); the rest of the verdict leaves them out.
    """

    method: Method
    reason: str
    autodiff: Float[np.ndarray, "frames"] | None
    narrow: Float[np.ndarray, "frames"] | None
    wide: Float[np.ndarray, "frames"]
    autodiff_parts: int | None
    differences_part: int
    kinks: tuple[str, ...]


def cosines(
    one: Float[np.ndarray, "dimension frames *features"], other: Float[np.ndarray, "dimension frames *features"]
) -> Float[np.ndarray, "frames"]:
    """Cosine between two derivatives, all parameters and features of a frame together; 1 where both vanish, 0 for NaN."""
    a, b = (np.moveaxis(x, 1, 0).reshape(x.shape[1], -1) for x in (one, other))
    with np.errstate(invalid="ignore", over="ignore"):
        lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
        cosine = (a * b).sum(1) / np.where(lengths > 0, lengths, 1.0)
    both_still = ~a.any(1) & ~b.any(1)
    return np.where(both_still, 1.0, np.where(np.isfinite(cosine), cosine, 0.0))


def differences(
    space: Space,
    point: Float[np.ndarray, "dimension"],
    frames: int,
    step: float,
    simulator: MujocoSimulator,
    image: tuple[int, int],
    directions: int = DIRECTIONS,
    chosen: Int[np.ndarray, "some"] | None = None,
) -> Float[np.ndarray, "some frames objects directions"]:
    """Derivatives of outlines [px per prior width] by second-order differences of C MuJoCo in double precision.

    ``step`` is in prior standard deviations; ``chosen`` are the parameters, all if None. NaN where a rollout diverged.
    """
    point = np.clip(np.asarray(point, np.float64), 0.0, 1.0)
    size = np.minimum(step * space.sigma, 0.25)
    points, weights = stencil(point, size)
    rows = np.arange(len(point)) if chosen is None else chosen
    points, weights = points[rows], weights[rows]
    batch = space.decode(np.concatenate([point[None], points.reshape(-1, len(point))]))
    poses = simulator.rollout(batch, frames)
    arrays = (poses, batch.size, batch.camera_position, batch.camera_pitch, batch.camera_fovy)
    reach = precise_outlines(space.scene.shapes, tuple(map(np.asarray, arrays)), image, directions)
    moved = reach[1:].reshape(len(rows), 2, *reach.shape[1:]) - reach[0]
    slopes = np.einsum("dk,dk...->d...", weights[:, 1:], moved)
    return slopes * space.sigma[rows, None, None, None]


def check(
    space: Space,
    point: Float[np.ndarray, "dimension"],
    frames: int,
    image: tuple[int, int],
    fps: float = 30.0,
    autodiff: Differentiator | None = None,
    simulator: MujocoSimulator | None = None,
    most: int | None = None,
) -> Verdict:
    """Compares derivatives of what is seen at ``point`` and chooses between them.

    Takes 4 rollouts a parameter in C MuJoCo; with automatic derivatives 6, and one with tangents in MJX-JAX.

    Args:
      space: the parameters.
      point: in the unit box.
      frames: how many.
      image: (width, height) [px].
      fps: frames a second, where no simulator says it.
      autodiff: without it (compiling MJX takes its time on a CPU) the choice is between the other two.
      simulator: the reference; made here if None.
      most: parameters that are looked at, evenly spread over all, where that is enough; None: all.

    Raises:
      ValueError: the point lies outside of the box, or the frame rates differ.
    """
    if autodiff is not None:
        fps = autodiff.simulator.fps
    simulator = simulator or MujocoSimulator(space.scene.shapes, fps)
    if autodiff is not None and simulator.fps != fps:
        raise ValueError(f"{simulator.fps} frames a second in MuJoCo, {fps} in MJX; expected the same")
    kinks = kinked(space, point)
    rows = np.nonzero(~kinks)[0]
    if most is not None and most < len(rows):
        rows = rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]

    def slopes_over(step: float) -> np.ndarray:
        return differences(space, point, frames, step, simulator, image, chosen=rows)

    wide, middle = (slopes_over(step) for step in STEPS[:2])
    along, fine, problem = None, None, ""
    if autodiff is not None:
        narrow = slopes_over(STEPS[2])
        fine = cosines(middle, narrow)
        try:
            slopes = autodiff.outlines(point, frames, image, DIRECTIONS)[1][rows] * space.sigma[rows, None, None, None]
            along = np.minimum(cosines(slopes, middle), cosines(slopes, narrow))
        except DerivativeError as error:
            problem = str(error)
    names = tuple(np.array(space.names)[kinks].tolist())
    return _judge(along, fine, cosines(wide, middle), names, problem)


def _parts(cosine: np.ndarray) -> int:
    """The first frame that disagrees, the number of frames if none does."""
    return int(np.argmax(cosine < ALIKE)) if (cosine < ALIKE).any() else len(cosine)


def _judge(along, narrow, wide: np.ndarray, kinks: tuple[str, ...], problem: str) -> Verdict:
    count = len(wide)
    apart, jagged = _parts(wide), _parts(wide if narrow is None else narrow)
    parts = None if along is None else _parts(along)
    if apart < ENOUGH * count:
        method: Method = "population"
        reason = (
            f"changes of 0.1 and of 0.01 prior widths disagree from frame {apart} of {count} on: "
            "the landscape is jagged and only a population search sees across it"
        )
    elif parts is not None and parts >= apart:
        method = "autodiff"
        reason = f"automatic derivatives agree with finite differences {_through(min(parts, apart), count)}"
    else:
        method = "differences"
        reason = f"wide finite differences agree with each other {_through(apart, count)}"
        if problem:
            reason += f"; automatic ones do not serve: {problem}"
        elif parts is not None and jagged <= parts:
            reason += f", narrow ones and automatic derivatives only to frame {parts}: a fine jag in the landscape"
        elif parts is not None:
            reason += f"; automatic derivatives part from them at frame {parts}"
    if kinks:
        reason += f"; no derivative here in {', '.join(kinks[:NAMED])}"
        reason += f" and {len(kinks) - NAMED} more" if len(kinks) > NAMED else ""
    return Verdict(method, reason, along, narrow, wide, parts, apart, kinks)


def _through(frame: int, count: int) -> str:
    return "in every frame" if frame >= count else f"up to frame {frame} of {count}"
