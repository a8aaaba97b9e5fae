"""Residuals of points in the unit box: how far simulated outlines and flow are from a clip's, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mjx_refine.batch import SceneBatch
from mjx_refine.search.features import DIRECTIONS, POINTS, Outlines, flow_of_objects
from mjx_refine.space import Space
from mjx_refine.view.seen import Look, seen_reach_and_flow

if TYPE_CHECKING:
    from mjx_refine.search.derivatives import Automatic

FLOW_NOISE = 1.0
"""Standard deviation of measured flow inside a mask [px at a picture 480 wide]."""

FLOW_SCALE = 2.0
"""Scale of its robust loss: measured flow of fast-spinning bodies is wrong by several pixels."""

NOISE_FLOOR = 0.5
"""Standard deviation of a mask's edge [px at a picture 480 wide]."""

STEP = 0.05
"""Of finite differences [prior widths]."""

EDGE_WEIGHT = float(np.sqrt(6 / DIRECTIONS)) / NOISE_FLOOR
MOTION_WEIGHT = float(np.sqrt(2 / POINTS)) / FLOW_NOISE
"""Of one direction of an outline, and of one coordinate of the flow at one point [1 / px at a picture 480 wide]."""

MOST_AHEAD = 1024
"""Candidates in a batch above which nothing is simulated ahead: of four objects an H100 simulates 128 in 13 ms, 512 in 16, 2,688
in 50."""

Looked = tuple[np.ndarray, np.ndarray | None, np.ndarray]
"""Reach (B, T, N, directions) and flow (B, T, N, points, 2) of simulations [px], and whether a candidate diverged."""


class Residuals:
    """The residuals of points in the unit box, and what they cost.

    Args:
      space: the parameters.
      rollout: poses of a batch for a number of frames.
      seen: the observed outlines.
      columns: for each object the column of ``seen`` that belongs to it, or -1.
      image: (width, height) [px].
      flow: pixels and observed flow of every mask (``flow_points``), or None to go by outlines alone.
      limit, seed, solver: of what minimises them: rollouts that may be spent; of the points tried when the horizon grows; what
        runs inside a stage, ``lm``, ours, or one of ``solvers``.
      automatic: derivatives where it has some; None: differences alone.
      fps: frames a second, for effects.
      look: tells reach and flow, as ``seen_reach_and_flow`` does.
      foresees: whether ``foresee`` simulates ahead: where more candidates in a batch cost next to nothing and another batch
        its latency, as on a GPU.
    """

    def __init__(
        self,
        space: Space,
        rollout: Callable[[SceneBatch, int], np.ndarray],
        seen: Outlines,
        columns: tuple[int, ...],
        image: tuple[int, int],
        flow: tuple[np.ndarray, np.ndarray] | None = None,
        limit: int = 10**9,
        seed: int = 0,
        solver: str = "lm",
        automatic: Automatic | None = None,
        fps: float = 30.0,
        look: Look = seen_reach_and_flow,
        foresees: bool = False,
    ):
        self.look, self.foresees = look, foresees
        self.limit, self.seed, self.solver, self.automatic = limit, seed, solver, automatic
        self.space, self.rollout, self.image, self.fps = space, rollout, image, fps
        self.pixel = image[0] / 480.0
        target = np.full((len(seen.support), len(columns), DIRECTIONS), np.nan)
        for n, j in enumerate(columns):
            if j >= 0:
                target[:, n] = seen.support[:, j]
        self.target = target
        self.pixels, self.flow = flow_of_objects(flow, columns)
        self.spent = 0.0
        self._foreseen: dict[tuple[int, bytes], Looked] = {}

    def foresee(self, points: np.ndarray, after: Iterable[np.ndarray], frames: int) -> None:
        """Simulates in one batch what ``distances`` will be asked for next, whole or row by row, and what it may be asked for
        after that; nothing, and without a look at ``after``, where that is slower.

        Forgotten when it is called again; only what is asked for counts as spent.
        """
        if not self.foresees:
            return
        batches = [points, *after]
        ends = np.cumsum([len(batch) for batch in batches])
        if ends[-1] > MOST_AHEAD or all((frames, batch.tobytes()) in self._foreseen for batch in batches):
            return
        seen, moved, bad = self._looked(np.concatenate(batches), frames)
        spans = [slice(end - len(batch), end) for batch, end in zip(batches, ends, strict=True)]
        rows = [slice(k, k + 1) for k in range(len(points))]
        self._foreseen = {
            (frames, batch.tobytes()): (seen[span], None if moved is None else moved[span], bad[span])
            for batch, span in zip([*batches, *points[:, None]], [*spans, *rows], strict=True)
        }

    def distances(self, points: np.ndarray, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulated minus observed reach (B, frames, N, directions) and flow (B, frames, N, 2 * points), both in px at
        480 wide, and whether a candidate diverged."""
        self.spent += len(points) * frames / len(self.target)
        foreseen = self._foreseen.get((frames, points.tobytes()))
        seen, moved, bad = self._looked(points, frames) if foreseen is None else foreseen
        reach = seen[:, :frames] - self.target[:frames]
        flow = np.full((len(points), frames, self.target.shape[1], 0), np.nan)
        if moved is not None and self.flow is not None:
            moved = moved[:, :frames] - self.flow[:frames]
            moved[:, frames - 1] = np.nan
            flow = moved.reshape(*moved.shape[:3], -1)
        return reach / self.pixel, flow / self.pixel, bad

    def _looked(self, points: np.ndarray, frames: int) -> Looked:
        batch = self.space.decode(points)
        poses = self.rollout(batch, frames)
        bad = np.logical_not(np.asarray(np.isfinite(poses).all((1, 2, 3))))
        poses = np.where(bad[:, None, None, None], [0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 0.0], poses)
        # The outlines of all frames, so that one length is compiled; those beyond the horizon repeat its last.
        beyond = np.repeat(poses[:, -1:], len(self.target) - frames, axis=1)
        poses = np.concatenate([poses, beyond], 1)
        pixels = self.pixels if self.flow is not None and frames > 1 else None
        seen, moved = self.look(poses, batch, pixels, self.image, DIRECTIONS, self.fps)
        return seen, moved, bad

    def _robust(self, reach: np.ndarray, flow: np.ndarray, scale: float) -> np.ndarray:
        """Residuals in noise widths, (B, frames, N, directions + 2 * points), zero where nothing was seen.

        Their growth slows beyond ``scale`` but never ends: a pull at any distance. Neither the edges of one mask nor the
        flow at its points are independent: its directions together count as six, its flow as two vectors.
        """
        edges = slowed(np.nan_to_num(reach), scale) * EDGE_WEIGHT
        motion = slowed(np.nan_to_num(flow), FLOW_SCALE) * MOTION_WEIGHT
        return np.concatenate([edges, motion], -1)

    def residuals(self, points: np.ndarray, frames: int, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """(robust residuals (B, R), their half sum of squares with the prior (B,))."""
        reach, flow, bad = self.distances(points, frames)
        robust = self._robust(reach, flow, scale).reshape(len(points), -1)
        prior = (points - self.space.start) / self.space.sigma
        cost = 0.5 * (robust**2).sum(-1) + 0.5 * (prior**2).sum(-1)
        return robust, np.where(bad, np.inf, cost)

    def jacobian(self, point: np.ndarray, base: np.ndarray, frames: int, scale: float) -> np.ndarray:
        """d residuals / d (prior widths), (R, D): automatic, or else finite differences towards the inside of the box."""
        result, held = np.zeros((len(base), len(point))), np.zeros(len(point), bool)
        with_flow = self.flow is not None and frames > 1
        told = self.automatic and self.automatic(point, frames, self.image, self.pixels if with_flow else None)
        if told:
            columns, held = told
            # A tangent is pushed through one rollout.
            self.spent += len(columns) * frames / len(self.target)
            slopes = self._robust_slopes(base.reshape(columns.shape[1:]), frames, scale)
            result[:, held] = (columns / self.pixel * slopes).reshape(len(columns), -1).T
        if not held.all():
            points, sign = self.beside(point)
            moved, _ = self.residuals(points[~held], frames, scale)
            result[:, ~held] = ((moved - base) / (sign[~held, None] * STEP)).T
        return result

    def beside(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The points (D, D) that differences at ``point`` look at, and to which side (D,) each lies."""
        step = STEP * self.space.sigma
        sign = np.where(point + step > 1.0, -1.0, 1.0)
        return np.clip(point + np.diag(sign * step), 0.0, 1.0), sign

    def _robust_slopes(self, base: np.ndarray, frames: int, scale: float) -> np.ndarray:
        """Derivatives of ``_robust`` in the raw distances, told from its own values; zero where nothing was seen."""
        seen = np.isfinite(self.target[:frames])
        factors = np.full(base.shape[-1], EDGE_WEIGHT)
        scales = np.full(base.shape[-1], scale)
        factors[DIRECTIONS:], scales[DIRECTIONS:] = MOTION_WEIGHT, FLOW_SCALE
        if self.flow is not None and frames > 1:
            measured = np.isfinite(self.flow[:frames]).reshape(*seen.shape[:2], -1)
            measured[frames - 1] = False
            seen = np.concatenate([seen, measured], -1)
        # With q = raw / scale and L = log(1 + q^2) the residual is sqrt(L), and its derivative q / ((1 + q^2) sqrt(L)).
        grown = (base / factors / scales) ** 2
        slopes = np.sqrt(np.expm1(grown) / np.maximum(grown, 1e-300)) * np.exp(-grown)
        return np.where(seen, np.where(grown > 1e-12, slopes, 1.0) * factors, 0.0)

    @property
    def evaluations(self) -> int:
        """Rollouts so far, in units of the whole clip: one of half its frames counts half."""
        return int(np.ceil(self.spent))


def slowed(raw: Float[np.ndarray, "*shape"], scale: float | np.ndarray) -> Float[np.ndarray, "*shape"]:
    """Residuals whose squares are Cauchy's loss: as they are below ``scale``, growing ever more slowly beyond."""
    return np.sign(raw) * scale * np.sqrt(np.log1p((raw / scale) ** 2))
