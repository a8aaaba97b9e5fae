"""How jagged a rollout is around a fit: what no least squares can follow is no evidence."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from mjx_refine.diagnosis.seen.measure import Parts
from mjx_refine.diagnosis.seen.predict import Prediction

DRAWS = 12
"""Pairs of rollouts that measure it."""

NEARBY = 5
"""Frames over which is averaged what a fit leaves."""

EXCUSED = 0.7
"""Multiple of what a fit leaves up to which jaggedness is believed: what it leaves holds the effect that is looked for, too."""


def drawn(
    z: Float[np.ndarray, "dimension"], curvature: Float[np.ndarray, "dimension dimension"], seed: int
) -> Float[np.ndarray, "points dimension"]:
    """Points a posterior standard deviation to either side of a fit, ``DRAWS`` and their mirror images, then the fit."""
    generator = np.random.default_rng(seed)
    factor = np.linalg.inv(np.linalg.cholesky(curvature))
    steps = generator.standard_normal((DRAWS, len(z))) @ factor
    return np.concatenate([z + steps, z - steps, z[None]])


def jaggedness(told: Prediction) -> Parts:
    """Half the second differences of predictions at ``drawn`` points, by frame and object (and moment) [px]."""

    def bend(values: np.ndarray) -> np.ndarray:
        second = values[:DRAWS] + values[DRAWS:-1] - 2 * values[-1:]
        square = np.nan_to_num(np.where(told.bad[:DRAWS].reshape(-1, *(1,) * (second.ndim - 1)), 0.0, second)) ** 2
        return np.sqrt(np.median(square.reshape(*square.shape[:3], -1).mean(-1), axis=0) / 2.0)

    moments = np.stack([bend(told.moments[..., k : k + 1]) for k in range(3)], -1)
    return Parts(bend(told.reach), bend(told.flow), moments, None)


def believed(jagged: Parts, residual: Parts, excused: float = EXCUSED) -> Parts:
    """How much of the jaggedness is excused: where the fit followed all the same, no more than it leaves.

    Args:
      jagged: of ``jaggedness`` [px].
      residual: what the fit leaves of each number [px].
      excused: multiple of that up to which it is believed.
    """

    def least(part: np.ndarray, square: np.ndarray) -> np.ndarray:
        # Running sums may end a little below zero.
        near = np.maximum(uniform_filter1d(square, NEARBY, axis=0), 0.0)
        return np.minimum(part, excused * np.sqrt(near))

    return Parts(
        least(jagged.reach, (residual.reach**2).mean(-1)),
        least(jagged.flow, (residual.flow**2).mean((-2, -1))),
        least(jagged.moments, residual.moments**2),
        None,
    )
