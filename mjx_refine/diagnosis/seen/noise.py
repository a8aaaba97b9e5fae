"""How noisy the measurements of a clip are, and as how many independent numbers they count."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.seen.measure import Measured, Parts, moment_roughness

EDGE_COUNT, FLOW_COUNT, BACKGROUND_COUNT = 6.0, 3.0, 6.0
"""As how many independent numbers the directions of one outline, the flow of one mask (each axis) and that of the
background (each axis) count in one frame, since neighbours err together; the first two until they are measured."""

EDGE_COUNTS, FLOW_COUNTS = (3.0, 6.0), (1.5, 10.0)
"""Bounds of these counts where they are measured."""

LEAST_EDGE = 0.12
"""Noise of outlines that is assumed at least [px]."""

BLUR = 0.05
"""How uncertain the moment of an impact is [frames]: contacts last, and how long is the engine's choice."""

MORE_THAN_ROUGH = 1.25
"""Multiple of what third differences of centroids themselves tell of their noise that it may be at most: what residuals tell
of it holds what the model lacks, too."""

LEAST_MOMENT = 0.03
"""Noise of centroids and equivalent radii that is assumed at least [px]."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations [px].

    Attributes:
      edge: of outlines.
      flow: of the objects' flow.
      moments: of centroids and equivalent radii.
      background: of the flow beside them.
    """

    edge: Float[np.ndarray, "frames objects"]
    flow: Float[np.ndarray, "intervals objects"]
    moments: Float[np.ndarray, "frames objects 3"]
    background: float

    def times(self, factor: float) -> Noise:
        """So many times as much."""
        return Noise(factor * self.edge, factor * self.flow, factor * self.moments, factor * self.background)


@dataclasses.dataclass(frozen=True)
class Counts:
    """As how many independent numbers the directions of one outline and the flow of one mask (each axis) count in a frame."""

    edge: float = EDGE_COUNT
    flow: float = FLOW_COUNT

    def of(self, parts: Parts) -> tuple[float, float, float, float]:
        """Of one number of each part."""
        return (
            self.edge / parts.reach.shape[-1],
            self.flow / parts.flow.shape[-2],
            1.0,
            BACKGROUND_COUNT / max(parts.background.shape[-2], 1),
        )


def jagged(measured: Measured, chaos: Parts, background: float) -> Noise:
    """The measurement's noise and what a rollout jumps by, together."""
    return Noise(
        np.hypot(measured.edge_noise, chaos.reach),
        np.hypot(measured.flow_noise, chaos.flow),
        np.hypot(measured.moment_noise, chaos.moments),
        background,
    )


def everywhere(measured: Measured, frames: int) -> Noise:
    """The same noise in every frame."""
    return Noise(
        np.repeat(measured.edge_noise[None], frames, 0),
        np.repeat(measured.flow_noise[None], frames - 1, 0),
        np.repeat(measured.moment_noise[None], frames, 0),
        measured.background_noise,
    )


def _independent(steps: np.ndarray) -> float:
    """As how many independent numbers the last axis counts: its length over the sum of its mean correlations."""
    count = steps.shape[-1]
    rows = steps.reshape(-1, count)
    rows = rows[(rows != 0).all(1)]
    if len(rows) < 10:
        return float(count) / 3
    # A few wild rows would speak for all.
    rows = rows / np.maximum(np.sqrt((rows**2).mean(1, keepdims=True)), 1e-12)
    return count / max(float((rows.sum(1) ** 2).mean()) / count, 1e-6)


def _middle(values: np.ndarray) -> float:
    """Median of what is finite; one where nothing is."""
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else 0.455


def settled(measured: Measured, residual: Parts, counts: Counts, order: int = 1) -> tuple[Measured, Counts]:
    """What changes from frame to frame in the residuals of a fit, which no smooth misfit does, taken for the noise.

    Args:
      measured: with the noise in whose widths the residuals are.
      residual: of the fit, without leading axis.
      counts: which the residuals were weighted with.
      order: of the differences. Large smooth misfits have large first ones; measurements that err smoothly have small second
        ones.
    """
    m, share = measured, counts.of(measured.parts)
    fresh = m.freshness > 0.5

    def rough(series: np.ndarray, seen: np.ndarray, part: float) -> np.ndarray:
        # Masks that stand still say nothing of their noise.
        moving = fresh[: len(series)].reshape(*fresh[: len(series)].shape, *(1,) * (series.ndim - 2))
        step = np.where(np.isfinite(seen) & moving, series, np.nan)
        square = np.diff(step, order, axis=0) ** 2 / math.comb(2 * order, order) / part
        return np.array([np.sqrt(_middle(square[:, n]) / 0.455) for n in range(series.shape[1])])

    edge = m.edge_noise * np.clip(rough(residual.reach, m.reach, share[0]), 0.4, 1.5)
    flow = m.flow_noise * np.clip(rough(residual.flow, m.flow, share[1]), 0.7, 3.0)
    each = [rough(residual.moments[..., k], m.moments[..., k], share[2]) for k in range(3)]
    moments = m.moment_noise * np.clip(np.stack(each, -1), 0.6, 3.0)
    moments = np.minimum(moments, MORE_THAN_ROUGH * moment_roughness(m.whole))
    edge_count = float(np.clip(_independent(np.diff(residual.reach, axis=0)), *EDGE_COUNTS))
    told = float(np.clip(_independent(np.moveaxis(np.diff(residual.flow, axis=0), -1, -2)), *FLOW_COUNTS))
    # Flow whose noise is not stated was measured, and errs smoothly in time as well.
    flow_count = told if m.stated else min(told, FLOW_COUNTS[0])
    settled_ones = dataclasses.replace(
        m,
        edge_noise=np.maximum(edge, LEAST_EDGE),
        flow_noise=flow,
        moment_noise=np.maximum(moments, LEAST_MOMENT),
    )
    return settled_ones, Counts(edge_count, flow_count)


def blurred(
    noise: Noise, moments: Float[np.ndarray, "frames objects 3"], impacts: list[tuple[int, int]], factor: float = 1.0
) -> Noise:
    """The noise with what the uncertain moment of impacts adds, in the frames around them.

    Args:
      noise: standard deviations.
      moments: predicted centroids and radii [px].
      impacts: (object, first frame after) of each.
      factor: of how uncertain it is.
    """
    edge, flow, whole = noise.edge.copy(), noise.flow.copy(), noise.moments.copy()
    bend = np.zeros_like(moments)
    bend[1:-1] = np.abs(np.nan_to_num(np.diff(moments, 2, axis=0)))
    for n, frame in impacts:
        near = slice(max(frame - 2, 0), frame + 2)
        off = factor * BLUR * bend[near, n].max(0, initial=0.0)
        whole[near, n] = np.hypot(whole[near, n], off)
        size = float(np.linalg.norm(off))
        edge[near, n] = np.hypot(edge[near, n], size)
        flow[near, n] = np.hypot(flow[near, n], size)
    return Noise(edge, flow, whole, noise.background)
