"""Drawing a generation, and putting given points into it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.linalg import lapack

from mjx_cmaes.settings import Settings, require
from mjx_cmaes.state import State, changed
from mjx_cmaes.types import Points

WIDE = 0.8
"""Gaussian rows per coordinate up to which they are far from dependent: their products' condition stayed below 1e5 in
thousands of draws of 2 to 84 coordinates."""


def ask(settings: Settings, state: State) -> tuple[Points, State]:
    """Draws a generation: points to evaluate, shape (population, n), and the state that remembers them.

    Where the search is bounded the points are projected onto the unit box, coordinate by coordinate, and the update
    takes the projected points as drawn. Of projection, adaptive penalties, reflection and unrepaired selection this was
    best by far on optima inside and on bounds alike.
    """
    population = settings.population_after(state.restarts)
    generator = np.random.default_rng([state.seed, state.draws, 0])
    normal = generator.standard_normal((population, settings.dimension))
    if settings.mirrored:
        normal = _mirror(normal)
    steps = (normal * state.axes) @ state.basis.T  # (T 38-39)
    points = state.mean + state.sigma * state.scale * steps  # (T 40)
    if settings.bounded:
        points = np.clip(points, 0.0, 1.0)
    return points, changed(state, draws=state.draws + 1, asked=points)


def inject(points: Points, given: Float[np.ndarray, "given dimension"]) -> Points:
    """The generation `points` with its first rows replaced by `given`, shape (population, n).

    First, because the first of equally good points is the one that is kept.

    `tell` notices rows that `ask` did not draw and limits their steps (`Settings.injection_limit`).
    Raises ValueError where there are more given points than rows, or their shape is wrong.
    """
    given = np.atleast_2d(np.asarray(given, dtype=np.float64))
    fits = given.ndim == 2 and given.shape[1] == points.shape[1] and len(given) <= len(points)
    require(fits, "given.shape", given.shape, f"(at most {len(points)}, {points.shape[1]})")
    require(bool(np.isfinite(given).all()), "given", "a non-finite coordinate", "finite numbers")
    return np.concatenate([given, points[len(given) :]])


def _mirror(normal: Points) -> Points:
    """Standard normal steps in pairs ±z, those of a block of n orthogonal to one another.

    Each row alone stays N(0, I) distributed: an orthogonal frame drawn uniformly, with the lengths of independent
    draws. Pairs cancel the even part of the cost in the mean's step (Brockhoff et al. 2010, "Mirrored Sampling and
    Sequential Selection for Evolution Strategies"); orthogonal blocks cover the directions evenly (Wang et al. 2014).
    """
    population, n = normal.shape
    half = (population + 1) // 2
    steps = normal[:half].copy()
    for first in range(0, half, n):
        block = steps[first : first + n]
        steps[first : first + n] = _orthonormal(block) * np.linalg.norm(block, axis=1)[:, None]
    return np.concatenate([steps, -steps])[:population]


def _orthonormal(rows: Points) -> Points:
    """The rows made orthonormal one after the other (Gram-Schmidt): a uniformly distributed frame, if they are Gaussian."""
    count, n = rows.shape
    if count <= WIDE * n:
        # The triangular factor of rows that are far from dependent is that of their products: a third of the time of a QR.
        return lapack.dtrtrs(np.linalg.cholesky(rows @ rows.T), rows, lower=1)[0]
    frame, upper = np.linalg.qr(rows.T)
    return (frame * np.where(np.diag(upper) < 0, -1.0, 1.0)).T
