"""Minus the log posterior of points at a measured noise, its minima, and how wide they are."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_refine.search.landing import LeastSquares
from mjx_refine.search.noise import DRAWS, TREMBLE, measured, unmeasured
from mjx_refine.search.residuals import slowed

CAUCHY = 2.5
"""Residuals beyond this many standard deviations count less (Cauchy's loss)."""

STEP = 0.05
"""Finite-difference step of the first Jacobian, and largest of the later ones [prior widths]."""

LEAST_STEP = 0.003
ITERATIONS = 8

RIDGES = (0.0, 0.1, 1.0, 10.0, 100.0)
TRIALS = np.array([1e-4, 1e-2, 1.0, 1e2, 1e4])

FEW, REMEMBERED = 8, 64
"""Rows of a batch whose distances are kept, and how many are: the trials of a fit."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Where a fit ended (unit box), its half sum of squares, its covariance [prior widths squared]."""

    point: Float[np.ndarray, "dimension"]
    cost: float
    covariance: Float[np.ndarray, "dimension dimension"]


class Posterior:
    """Minus the log posterior of points at a measured noise, and Levenberg-Marquardt on it."""

    def __init__(self, squares: LeastSquares):
        self.squares, self.space = squares, squares.space
        self.frames = len(squares.target)
        objects, directions = squares.target.shape[1:]
        self.points = 0 if squares.flow is None else squares.flow.shape[2]
        self.noise = unmeasured(self.frames, objects, directions, self.points)
        self._known: dict[bytes, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def _distances(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``squares.distances`` over all frames; what one fit ends with the next begins with, and is not simulated again."""
        if len(points) == 1 and points.tobytes() in self._known:
            return self._known[points.tobytes()]
        reach, flow, bad = self.squares.distances(points, self.frames)
        if len(points) <= FEW:
            for k, point in enumerate(points):
                self._known[point.tobytes()] = reach[k : k + 1].copy(), flow[k : k + 1].copy(), bad[k : k + 1].copy()
            while len(self._known) > REMEMBERED:
                del self._known[next(iter(self._known))]
        return reach, flow, bad

    def measure_noise(self, point: np.ndarray) -> None:
        """What the residuals at ``point`` scatter by, and simulations that start next to it."""
        draws = np.random.default_rng(0).standard_normal((DRAWS, len(point))) * TREMBLE * self.space.sigma
        draws = np.clip(point + draws, 0.0, 1.0)
        # A fit from there is what mostly follows.
        self.squares.foresee(point[None], (draws, self._stepped(point, np.full(len(point), STEP), 0)[0]), self.frames)
        reach, flow, _ = self._distances(point[None])
        self.noise = measured(reach[0], flow[0], self.squares.pixels / self.squares.pixel)
        self.noise = self.noise.with_scatter(self._standardised(draws)[0])

    def _standardised(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        reach, flow, bad = self._distances(points)
        return slowed(self.noise.standardised(reach, flow).reshape(len(points), -1), CAUCHY), bad

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(robust residuals (B, R), costs (B,))."""
        robust, bad = self._standardised(points)
        robust = self.noise.settled(robust)
        prior = (points - self.space.start) / self.space.sigma
        cost = 0.5 * (robust**2).sum(-1) + 0.5 * (prior**2).sum(-1)
        return robust, np.where(bad, np.inf, cost)

    def fit(self, point: np.ndarray, iterations: int = ITERATIONS, axes: np.ndarray | None = None) -> Fit:
        """Levenberg-Marquardt with difference steps that follow the standard errors down; ``axes``: of the ``spread`` that
        comes next, if they are known."""
        sigma, size = self.space.sigma, len(point)
        steps, damping, idle = np.full(size, STEP), 1e-2, 0
        self.squares.foresee(point[None], (self._stepped(point, steps, 0)[0],), self.frames)
        base, costs = self(point[None])
        base, cost, covariance = base[0], float(costs[0]), np.eye(size)
        for iteration in range(iterations):
            jacobian = self._jacobian(point, base, steps, iteration)
            gradient = jacobian.T @ base + (point - self.space.start) / sigma
            curvature = jacobian.T @ jacobian + np.eye(size)
            covariance = np.linalg.inv(curvature)
            steps = np.clip(np.sqrt(np.diag(covariance)), LEAST_STEP, STEP)
            trials = []
            for factor in damping * TRIALS:
                step = -np.linalg.solve(curvature + factor * np.diag(np.diag(curvature)), gradient)
                step *= min(1.0, 1.0 / max(np.abs(step).max(), 1e-12))
                trials.append(np.clip(point + step * sigma, 0.0, 1.0))
            trials = np.array(trials)
            # Where the next step is taken from: a trial, or again from here.
            ends = [*trials, point]
            if iteration + 1 < iterations:
                after = (self._stepped(end, steps, iteration + 1)[0] for end in ends)
            else:
                after = (self._astride(end, axes) for end in ends if axes is not None)
            self.squares.foresee(trials, after, self.frames)
            moved, costs = self(trials)
            best = int(np.argmin(costs))
            gain = cost - float(costs[best])
            if gain > 0:
                point, base, cost = trials[best], moved[best], float(costs[best])
                damping = float(np.clip(damping * TRIALS[best], 1e-8, 1e3))
            else:
                damping = min(damping * 1e3, 1e3)
            idle = idle + 1 if gain < 0.1 else 0
            if idle == 2:
                break
        return Fit(point, cost, covariance)

    def spread(self, point: np.ndarray, factor: np.ndarray, iterations: int) -> Fit:
        """Refines point and spread together; ``factor`` has the spread's principal axes as columns [prior widths]."""
        base, costs = self(point[None])
        base, cost = base[0], float(costs[0])
        for iteration in range(iterations):
            slopes, weights, bent = self._along(point, base, factor)
            curvature = slopes.T @ (weights[:, None] * slopes)
            # Slopes of a jagged function are noisy, and squares of noise add up: that much is taken off again. Noise
            # of variance v in each residual gives slopes v / 2 and bends 3 v / 2.
            diagonal = np.maximum(np.diag(curvature), 1e-12)
            kept = np.sqrt(np.maximum(1 - (weights[:, None] * bent**2).sum(0) / (3 * diagonal), 0.1))
            curvature = curvature * np.outer(kept, kept) + factor.T @ factor
            gradient = slopes.T @ (weights * base) + factor.T @ ((point - self.space.start) / self.space.sigma)
            steps = [-factor @ np.linalg.solve(curvature + f * np.eye(len(point)), gradient) for f in RIDGES]
            steps = [step * min(1.0, 1.0 / max(np.abs(step).max(), 1e-12)) for step in steps]
            trials = np.clip(point + np.array(steps) * self.space.sigma, 0.0, 1.0)
            widths, axes = np.linalg.eigh(curvature)
            factor = factor @ axes / np.sqrt(np.clip(widths, 1 / 9, 9.0))
            ends = (*trials, point) if iteration + 1 < iterations else ()
            self.squares.foresee(trials, (self._astride(end, factor) for end in ends), self.frames)
            moved, costs = self(trials)
            best = int(np.argmin(costs))
            if costs[best] < cost:
                point, base, cost = trials[best], moved[best], float(costs[best])
        return Fit(point, cost, factor @ factor.T)

    def _along(self, point: np.ndarray, base: np.ndarray, factor: np.ndarray):
        """Slopes (R, D) along the columns of ``factor``, weights (R,) of the residuals, and their bends (R, D)."""
        sigma, size = self.space.sigma, len(point)
        both = self._astride(point, factor)
        residuals, _ = self(both)
        ahead, behind = both[:size], both[size:]
        # At a bound of the box less than the whole distance is gone.
        gone = np.linalg.norm((ahead - behind) / sigma, axis=1) / np.maximum(2 * np.linalg.norm(factor, axis=0), 1e-12)
        slopes = ((residuals[:size] - residuals[size:]) / 2 / np.maximum(gone, 0.2)[:, None]).T
        bent = ((residuals[:size] + residuals[size:]) / 2 - base).T
        return slopes, 1 / (1 + (bent**2).sum(1)), bent

    def _astride(self, point: np.ndarray, factor: np.ndarray) -> np.ndarray:
        """The points (2 D, D) a column of ``factor`` ahead and behind."""
        along = factor.T * self.space.sigma
        return np.clip(np.concatenate([point + along, point - along]), 0.0, 1.0)

    def _jacobian(self, point: np.ndarray, base: np.ndarray, steps: np.ndarray, turn: int) -> np.ndarray:
        """d residuals / d prior widths by one-sided differences, the side alternating from turn to turn, (R, D)."""
        points, gone = self._stepped(point, steps, turn)
        moved, _ = self(points)
        return ((moved - base) / gone[:, None]).T

    def _stepped(self, point: np.ndarray, steps: np.ndarray, turn: int) -> tuple[np.ndarray, np.ndarray]:
        """The points (D, D) that ``_jacobian`` looks at, and how far [prior widths] each is gone, (D,)."""
        sigma = self.space.sigma
        sign = np.where((np.arange(len(point)) + turn) % 2 == 0, 1.0, -1.0)
        beyond = point + sign * steps * sigma
        sign = np.where((beyond > 1.0) | (beyond < 0.0), -sign, sign)
        return np.clip(point + np.diag(sign * steps * sigma), 0.0, 1.0), sign * steps
