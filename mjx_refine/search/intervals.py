"""What a clip determines: the posterior's spread around the solution, and refits from several starts within it.

After contacts the sum of squares is jagged, and a scene's overall scale, say, changes no picture: derivatives at a point
say how sharp a notch is, and differences of single parameters do not cancel well enough to show that a direction is
flat. So residuals are differenced along the principal axes of the spread itself, one standard deviation to each side,
until the spread agrees with what it measures (statistical linearisation: Lefebvre et al., Kalman filters for
non-linear systems, Int. J. Control 77, 2004; iterated as in Garcia-Fernandez et al., Posterior linearization filter,
IEEE Trans. Signal Processing 63, 2015). What is no straight line over that distance counts as noise. The solution is
then fitted again from several starts. The covariance is the mean of the fits' (within) and their scatter about the best
(between), as for estimates from several imputations (Rubin, Multiple Imputation for Nonresponse in Surveys, 1987,
eq. 3.1.5). Where an object is not fitted to what masks can tell, as after a contact that went another way than in the
clip, the solution is not near the truth, and no curvature says how far: its standard errors grow in proportion, those of
the others, which it may have touched, by the geometric mean of both factors.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.search.landing import LeastSquares
from mjx_refine.search.noise import DRAWS, TREMBLE, Noise, measured, unmeasured
from mjx_refine.search.residuals import slowed
from mjx_refine.space import Space

CONFIDENCE = 0.90

INFLATION = 1.2
"""Factor on the standard errors, calibrated on generated clips (``benchmarks.parameters``) that no table reports."""

CONTACT_INFLATION = 1.5
"""Further factor for what acts through contacts alone: there costs are jagged, and errors have longer tails."""

CONTACT = ("friction", "resistance", "mass")
"""Fields of the parameter space that do."""

EDGE_FITS = 0.5
"""Standard deviation of outlines [px at a picture 480 wide] that pixels and features explain: 0.2 to 0.4 at the truth of
generated clips. More, and the object is not fitted."""

MOTION_FITS = 1.5
"""The same of flow, in multiples of the best object's: one picture's flow is measured alike everywhere."""

DETERMINED = 0.3
"""Standard error, in prior widths, below which the clip is said to determine a parameter."""

CAUCHY = 2.5
"""Residuals beyond this many standard deviations count less (Cauchy's loss)."""

STEP = 0.05
"""Finite-difference step of the first Jacobian, and largest of the later ones [prior widths]."""

LEAST_STEP = 0.003
ITERATIONS = 8
LEAST_AXIS = 0.003
SETTLE, REFIT = 8, 3
"""Iterations of the first spread, and of each refit's."""

AWAY = 3.0
"""Standard deviations by which a refit's start is away from the last refit's end; along what the clip leaves open at
most a prior width."""

SCALE = 0.12
"""Standard deviation of the logarithm of a sample's overall scale: its lengths, speeds and gravity are wrong together,
and no clip tells."""

RIDGES = (0.0, 0.1, 1.0, 10.0, 100.0)
TRIALS = np.array([1e-4, 1e-2, 1.0, 1e2, 1e4])

FEW, REMEMBERED = 8, 64
"""Rows of a batch whose distances are kept, and how many are: the trials of a fit."""

SCALED = ("m", "m/s", "m/s^2")
"""Units of what the overall scale multiplies."""

ON_BOUND = 1e-3
"""Distance to a bound in the unit box within which a parameter is said to lie on it."""


@dataclasses.dataclass(frozen=True)
class FreeDirection:
    """Parameters that the clip leaves free to change together.

    Attributes:
      spread: standard deviation along it [prior widths].
      weights: share of each parameter that takes part, in prior widths, largest first.
    """

    spread: float
    weights: tuple[tuple[str, float], ...]


@dataclasses.dataclass(frozen=True)
class Intervals:
    """Marginal 90 % intervals of all parameters around a point.

    Attributes:
      point: the best refit, unit box.
      cost: its half sum of squares.
      standard_error: [prior widths].
      covariance: [prior widths squared].
      low, high: ends of the intervals, unit box.
      determined: whether the clip, not the prior, gives the value.
      on_bound: whether the point lies on the edge of the box.
      free: directions that the clip leaves free, widest first.
      misfit: factors on the standard errors for what is not fitted, by object; 1 where all is.
      edge, motion: estimated standard deviations of outlines and flow, by object [px at a picture 480 wide].
      evaluations: rollouts that it took.
    """

    point: Float[np.ndarray, "dimension"]
    cost: float
    standard_error: Float[np.ndarray, "dimension"]
    covariance: Float[np.ndarray, "dimension dimension"]
    low: Float[np.ndarray, "dimension"]
    high: Float[np.ndarray, "dimension"]
    determined: Bool[np.ndarray, "dimension"]
    on_bound: Bool[np.ndarray, "dimension"]
    free: tuple[FreeDirection, ...]
    misfit: Float[np.ndarray, "objects"]
    edge: Float[np.ndarray, "objects"]
    motion: Float[np.ndarray, "objects"]
    evaluations: int


@dataclasses.dataclass(frozen=True)
class _Fit:
    point: np.ndarray
    cost: float
    covariance: np.ndarray


class _Posterior:
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
                self._known[point.tobytes()] = reach[k : k + 1], flow[k : k + 1], bad[k : k + 1]
            while len(self._known) > REMEMBERED:
                del self._known[next(iter(self._known))]
        return reach, flow, bad

    def measure_noise(self, point: np.ndarray) -> None:
        """What the residuals at ``point`` scatter by, and simulations that start next to it."""
        reach, flow, _ = self._distances(point[None])
        self.noise = measured(reach[0], flow[0], self.squares.pixels / self.squares.pixel)
        draws = np.random.default_rng(0).standard_normal((DRAWS, len(point))) * TREMBLE * self.space.sigma
        self.noise = self.noise.with_scatter(self._standardised(np.clip(point + draws, 0.0, 1.0))[0])

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

    def fit(self, point: np.ndarray, iterations: int = ITERATIONS) -> _Fit:
        """Levenberg-Marquardt with difference steps that follow the standard errors down."""
        sigma, size = self.space.sigma, len(point)
        steps, damping, idle = np.full(size, STEP), 1e-2, 0
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
            moved, costs = self(np.array(trials))
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
        return _Fit(point, cost, covariance)

    def spread(self, point: np.ndarray, factor: np.ndarray, iterations: int) -> _Fit:
        """Refines point and spread together; ``factor`` has the spread's principal axes as columns [prior widths]."""
        base, costs = self(point[None])
        base, cost = base[0], float(costs[0])
        for _ in range(iterations):
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
            moved, costs = self(trials)
            best = int(np.argmin(costs))
            if costs[best] < cost:
                point, base, cost = trials[best], moved[best], float(costs[best])
            widths, axes = np.linalg.eigh(curvature)
            factor = factor @ axes / np.sqrt(np.clip(widths, 1 / 9, 9.0))
        return _Fit(point, cost, factor @ factor.T)

    def _along(self, point: np.ndarray, base: np.ndarray, factor: np.ndarray):
        """Slopes (R, D) along the columns of ``factor``, weights (R,) of the residuals, and their bends (R, D)."""
        sigma, size = self.space.sigma, len(point)
        ahead = np.clip(point + factor.T * sigma, 0.0, 1.0)
        behind = np.clip(point - factor.T * sigma, 0.0, 1.0)
        residuals, _ = self(np.concatenate([ahead, behind]))
        # At a bound of the box less than the whole distance is gone.
        gone = np.linalg.norm((ahead - behind) / sigma, axis=1) / np.maximum(2 * np.linalg.norm(factor, axis=0), 1e-12)
        slopes = ((residuals[:size] - residuals[size:]) / 2 / np.maximum(gone, 0.2)[:, None]).T
        bent = ((residuals[:size] + residuals[size:]) / 2 - base).T
        return slopes, 1 / (1 + (bent**2).sum(1)), bent

    def _jacobian(self, point: np.ndarray, base: np.ndarray, steps: np.ndarray, turn: int) -> np.ndarray:
        """d residuals / d prior widths by one-sided differences, the side alternating from turn to turn, (R, D)."""
        sigma = self.space.sigma
        sign = np.where((np.arange(len(point)) + turn) % 2 == 0, 1.0, -1.0)
        beyond = point + sign * steps * sigma
        sign = np.where((beyond > 1.0) | (beyond < 0.0), -sign, sign)
        moved, _ = self(np.clip(point + np.diag(sign * steps * sigma), 0.0, 1.0))
        return ((moved - base) / (sign * steps)[:, None]).T


def _axes(covariance: np.ndarray) -> np.ndarray:
    """Principal axes as columns, a standard deviation long but no shorter than ``LEAST_AXIS``."""
    variances, directions = np.linalg.eigh(covariance)
    return directions * np.maximum(np.sqrt(np.maximum(variances, 0.0)), LEAST_AXIS)


def _no_wider_than_prior(covariance: np.ndarray) -> np.ndarray:
    variances, directions = np.linalg.eigh(covariance)
    return (directions * np.clip(variances, 0.0, 1.0)) @ directions.T


def intervals(squares: LeastSquares, point: Float[np.ndarray, "dimension"], refits: int, seed: int) -> Intervals:
    """Refits around ``point`` and what their curvatures and scatter say about each parameter.

    Args:
      squares: the residuals.
      point: the solution, unit box.
      refits: how many, at least 1.
      seed: of their starts.
    """
    from scipy import special  # takes a third of a second to import

    before = squares.evaluations
    posterior = _Posterior(squares)
    space, sigma = squares.space, squares.space.sigma
    for _ in range(2):
        posterior.measure_noise(point)
        point = posterior.fit(point).point
    posterior.measure_noise(point)
    first = posterior.fit(point)
    first = posterior.spread(first.point, _axes(first.covariance), SETTLE)
    posterior.measure_noise(first.point)
    # Costs are compared with those of the refits, at the same noise.
    first = dataclasses.replace(first, cost=float(posterior(first.point[None])[1][0]))
    generator = np.random.default_rng([seed, 17])
    fits = [first]
    for _ in range(refits):
        # Each starts from where the last one ended: valleys are curved, and a chain follows them.
        axes = _axes(fits[-1].covariance)
        reach = np.clip(1.0 / np.linalg.norm(axes, axis=0), 1.0, AWAY)
        away = (axes * reach) @ generator.standard_normal(len(point))
        back = posterior.fit(np.clip(fits[-1].point + away * sigma, 0.0, 1.0), 3)
        fits.append(posterior.spread(back.point, 1.3 * axes, REFIT))
    best = min(fits, key=lambda fit: fit.cost)
    within = np.mean([fit.covariance for fit in fits], 0)
    apart = np.array([(fit.point - best.point) / sigma for fit in fits if fit is not best])
    between = apart.T @ apart / max(len(apart), 1)
    posterior.measure_noise(best.point)
    misfit = _misfit(squares, posterior.noise)
    factors = _inflation(space, misfit)
    gauge = _scale_direction(space, best.point)
    covariance = _no_wider_than_prior(np.outer(factors, factors) * (within + between)) + SCALE**2 * np.outer(
        gauge, gauge
    )
    error = np.minimum(np.sqrt(np.diag(covariance)), 1.0)
    reach = special.stdtrit(refits, 0.5 + CONFIDENCE / 2) * error * sigma
    edge = (best.point < ON_BOUND) | (best.point > 1 - ON_BOUND)
    return Intervals(
        point=best.point,
        cost=best.cost,
        standard_error=error,
        covariance=covariance,
        low=np.clip(best.point - reach, 0.0, 1.0),
        high=np.clip(best.point + reach, 0.0, 1.0),
        determined=(error < DETERMINED) & ~edge,
        on_bound=edge,
        free=_free(space, covariance),
        misfit=misfit,
        edge=posterior.noise.told[0],
        motion=posterior.noise.told[1],
        evaluations=squares.evaluations - before,
    )


def _misfit(squares: LeastSquares, noise: Noise) -> np.ndarray:
    """How many times larger than explicable each object's deviations are, at least 1, (N,)."""
    edge, motion = noise.told
    measured_flow = np.zeros(len(motion), bool)
    if squares.flow is not None:
        measured_flow = np.isfinite(squares.flow).any((0, 2, 3))
    seen = np.isfinite(squares.target).any((0, 2))
    least = motion[measured_flow].min() if measured_flow.any() else np.inf
    own = np.where(seen, edge / EDGE_FITS, 1.0)
    return np.maximum(np.maximum(own, np.where(measured_flow, motion / (MOTION_FITS * least), 1.0)), 1.0)


def _inflation(space: Space, misfit: np.ndarray) -> np.ndarray:
    """Factors on the standard errors, (D,): camera and gravity share the worst object's misfit."""
    worst = float(misfit.max(initial=1.0))
    result = np.full(space.dimension, INFLATION)
    for j, parameter in enumerate(space.parameters):
        owner = parameter.index[0]
        result[j] *= worst if owner < 0 else np.sqrt(misfit[owner] * worst)
        if parameter.field in CONTACT:
            result[j] *= CONTACT_INFLATION
    return result


def _scale_direction(space: Space, point: np.ndarray) -> np.ndarray:
    """Change of every parameter [prior widths] where all lengths grow by one e-fold, seen from the camera's foot."""
    result = np.zeros(space.dimension)
    if "camera.height" not in space.names:
        return result
    for j, (parameter, value) in enumerate(zip(space.parameters, space.values(point), strict=True)):
        if parameter.field == "position":
            change = value - space.scene.camera.position[parameter.index[1]]
        elif parameter.unit in SCALED:
            change = value
        else:
            continue
        result[j] = (change if parameter.offset is None else change / (value + parameter.offset)) / parameter.width
    return result


def _free(space: Space, covariance: np.ndarray) -> tuple[FreeDirection, ...]:
    """Principal directions wider than ``DETERMINED`` in which several parameters take part."""
    variances, directions = np.linalg.eigh(covariance)
    result = []
    for j in np.argsort(variances)[::-1]:
        spread = float(np.sqrt(max(variances[j], 0.0)))
        weights = directions[:, j] * np.sign(directions[np.argmax(np.abs(directions[:, j])), j])
        order = [int(k) for k in np.argsort(-np.abs(weights)) if abs(weights[k]) > 0.25]
        if spread > DETERMINED and len(order) > 1:
            names = tuple((space.names[k], round(float(weights[k]), 2)) for k in order)
            result.append(FreeDirection(round(spread, 3), names))
    return tuple(result)
