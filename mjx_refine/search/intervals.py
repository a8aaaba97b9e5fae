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
from mjx_refine.search.noise import Noise
from mjx_refine.search.posterior import Posterior
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

LEAST_AXIS = 0.003
SETTLE, REFIT = 8, 3
"""Iterations of the first spread, and of each refit's."""

AWAY = 3.0
"""Standard deviations by which a refit's start is away from the last refit's end; along what the clip leaves open at
most a prior width."""

SCALE = 0.12
"""Standard deviation of the logarithm of a sample's overall scale: its lengths, speeds and gravity are wrong together,
and no clip tells."""

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
    posterior = Posterior(squares)
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
        back = posterior.fit(np.clip(fits[-1].point + away * sigma, 0.0, 1.0), 3, 1.3 * axes)
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
