"""How far residuals of outlines and flow scatter, and together with which others.

Four things make residuals of one clip fewer measurements than they are numbers:

- Flow inside a mask is measured smoothly: errors at neighbouring points are alike. Their covariance is a white part and a
  part that falls with the squared distance of the points (a nugget and a Gaussian covariance: Rasmussen & Williams,
  Gaussian Processes for Machine Learning, 2006, eq. 4.9 and 5.8), share and length being the likeliest.
- The edge of a mask that hardly moves is wrong by the same in frame after frame, and in neighbouring directions. Variances
  grow by the sum of autocorrelations (Geyer, Practical Markov chain Monte Carlo, Statistical Science 7, 1992).
- After a contact that went otherwise than in the clip everything is off: deviations are measured around each frame.
- Contacts amplify rounding: change a scene by 1e-9 and bodies end up centimetres away. The clip is one draw of that, a
  simulation another. The scatter of simulations that differ by next to nothing is taken as noise, with all its
  correlations.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

EDGE_FLOOR = 0.15
"""Least standard deviation of an outline's distance [px at a picture 480 wide]: masks are drawn on a grid."""

MOTION_FLOOR = 0.2
"""The same of flow: more than a simulation without noise would need, but contacts are not right to less."""

WINDOW = 4
"""Frames to each side over which deviations are measured."""

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
LENGTHS = (4.0, 8.0, 16.0, 32.0, 64.0)
"""What is tried for the smooth part of the flow's error: its share of the variance, its length [px at 480 wide]."""

OUTLYING = 3.0
"""Deviations beyond this many standard ones count as this many when correlations are measured."""

DRAWS = 24
TREMBLE = 1e-6
"""Simulations that tell how much contacts amplify, and how far apart they start [prior widths]."""

SIMULATED = 2.0
"""Variances of that scatter between a clip and a simulation: one each."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations of residuals and their correlations.

    Attributes:
      edge: of outlines by frame and object, correlation included [px at a picture 480 wide].
      motion: of flow, ditto.
      whitener: of the flow's points of one mask: times them, they are uncorrelated and of unit variance [1 / px].
      axes, gains: directions of the residual vector in which simulations scatter, and what is taken off along them.
      told: the plain standard deviations by object (edge, motion), without correlations [px at a picture 480 wide].
    """

    edge: Float[np.ndarray, "frames objects"]
    motion: Float[np.ndarray, "frames objects"]
    whitener: Float[np.ndarray, "frames objects points points"]
    axes: Float[np.ndarray, "residuals scatter"]
    gains: Float[np.ndarray, "scatter"]
    told: tuple[Float[np.ndarray, "objects"], Float[np.ndarray, "objects"]]

    def standardised(self, reach: np.ndarray, flow: np.ndarray) -> np.ndarray:
        """Residuals (B, T, N, directions + 2 * points) in standard deviations, zero where nothing was seen."""
        edges = np.nan_to_num(reach) / self.edge[..., None]
        points = np.nan_to_num(flow).reshape(*flow.shape[:3], flow.shape[3] // 2, 2)
        motion = (self.whitener @ points).reshape(flow.shape) / self.motion[..., None]
        return np.concatenate([edges, motion], -1)

    def settled(self, residuals: Float[np.ndarray, "batch residuals"]) -> Float[np.ndarray, "batch residuals"]:
        """Residuals with the scatter of simulations whitened too."""
        return residuals - ((residuals @ self.axes) * self.gains) @ self.axes.T

    def with_scatter(self, draws: Float[np.ndarray, "draws residuals"]) -> Noise:
        """This noise and that of simulations ``draws`` of nearly one point, in standard deviations."""
        apart = (draws - draws.mean(0)) / np.sqrt(len(draws) - 1)
        _, lengths, axes = np.linalg.svd(apart, full_matrices=False)
        kept = lengths > 1e-3
        gains = 1 - 1 / np.sqrt(1 + SIMULATED * lengths[kept] ** 2)
        return dataclasses.replace(self, axes=axes[kept].T, gains=gains)


def unmeasured(frames: int, objects: int, directions: int, points: int) -> Noise:
    """One pixel for outlines and half a one for flow, uncorrelated."""
    size = frames * objects * (directions + 2 * points)
    whitener = np.broadcast_to(np.eye(points), (frames, objects, points, points))
    edge, motion = np.ones((frames, objects)), np.full((frames, objects), 0.5)
    return Noise(edge, motion, whitener, np.zeros((size, 0)), np.zeros(0), (edge[0], motion[0]))


def measured(
    reach: Float[np.ndarray, "frames objects directions"],
    flow: Float[np.ndarray, "frames objects coordinates"],
    pixels: Float[np.ndarray, "frames objects points 2"],
) -> Noise:
    """The noise that residuals at a solution [px at a picture 480 wide] show, object by object."""
    frames, objects, directions = reach.shape
    points = flow.shape[2] // 2
    blank = unmeasured(frames, objects, directions, points)
    edge, motion, whitener = blank.edge.copy(), blank.motion.copy(), blank.whitener.copy()
    told = np.ones((2, objects))
    for n in range(objects):
        told[:, n] = deviation(reach[:, n], EDGE_FLOOR), deviation(flow[:, n], MOTION_FLOOR)
        edge[:, n] = _around(reach[:, n], EDGE_FLOOR, told[0, n])
        standard = np.clip(reach[:, n] / edge[:, n, None], -OUTLYING, OUTLYING)
        edge[:, n] *= np.sqrt(_repeats(standard, _later) * _repeats(standard, _beside))
        motion[:, n] = _around(flow[:, n], MOTION_FLOOR, told[1, n])
        standard = np.clip(flow[:, n] / motion[:, n, None], -OUTLYING, OUTLYING).reshape(frames, points, 2)
        whitener[:, n] = _whitener(standard, pixels[:, n]) if points else whitener[:, n]
        if points:
            motion[:, n] *= np.sqrt(_repeats(standard.mean(1), _later))
    return dataclasses.replace(blank, edge=edge, motion=motion, whitener=whitener, told=(told[0], told[1]))


def deviation(values: np.ndarray, floor: float) -> float:
    """Robust standard deviation of residuals about zero; 1 where there are none."""
    seen = values[np.isfinite(values)]
    return max(1.4826 * float(np.median(np.abs(seen))), floor) if len(seen) else 1.0


def _around(values: np.ndarray, floor: float, overall: float) -> np.ndarray:
    """Deviations about each frame, (T,); the overall one where next to nothing is seen there."""
    result = np.full(len(values), overall)
    for t in range(len(values)):
        near = values[max(t - WINDOW, 0) : t + WINDOW + 1]
        if np.isfinite(near).sum() >= 2 * WINDOW:
            result[t] = deviation(near, floor)
    return result


def _later(values: np.ndarray, lag: int) -> np.ndarray:
    return values[lag:] * values[:-lag]


def _beside(values: np.ndarray, lag: int) -> np.ndarray:
    return values * np.roll(values, lag, 1)


def _repeats(values: np.ndarray, product) -> float:
    """How many numbers make one measurement, by the autocorrelations up to the first that is about zero."""
    variance = float(np.nanmean(values**2)) if np.isfinite(values).any() else 0.0
    if variance <= 0:
        return 1.0
    length = len(values) if product is _later else values.shape[1]
    total = 1.0
    for lag in range(1, length // 2 if product is _later else length // 4 + 1):
        products = product(values, lag)
        if np.isfinite(products).sum() < 8:
            break
        correlation = float(np.nanmean(products)) / variance
        if correlation < 0.05:
            break
        total += 2 * min(correlation, 1.0) * (1 - lag / length)
    return total


def _whitener(
    standard: Float[np.ndarray, "frames points 2"], pixels: Float[np.ndarray, "frames points 2"]
) -> np.ndarray:
    """Inverse Cholesky factors (T, P, P) of the likeliest correlation between the points of one mask."""
    frames, points = standard.shape[:2]
    identity = np.eye(points)
    seen = np.isfinite(standard).all((1, 2))
    if seen.sum() < 2:
        return np.broadcast_to(identity, (frames, points, points))
    squared = ((pixels[:, :, None] - pixels[:, None]) ** 2).sum(-1)
    best, result = -np.inf, identity
    for share in SHARES:
        for length in LENGTHS if share else LENGTHS[:1]:
            correlation = share * np.exp(-squared / (2 * length**2)) + (1 - share) * identity
            factors = np.linalg.inv(np.linalg.cholesky(correlation))
            white = factors[seen] @ standard[seen]
            spread = np.log(np.diagonal(factors[seen], axis1=1, axis2=2)).sum()
            likely = 2 * spread - white.size / 2 * np.log(max((white**2).mean(), 1e-12))
            if likely > best:
                best, result = likely, factors
    return result
