"""The update: one generation's costs become the next distribution.

Equation numbers: (T …) Hansen 2016, arXiv:1604.00772; (D …) Akimoto & Hansen 2020, arXiv:1905.05885, the diagonal
acceleration; injected points: Hansen 2011, "Injecting External Solutions Into CMA-ES", arXiv:1110.4181.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mjx_cmaes.parameters import Parameters, Rates, parameters
from mjx_cmaes.ranking import Ranking, failures_last, rank_weights, recombination_weights
from mjx_cmaes.settings import Settings, require
from mjx_cmaes.state import Info, State, changed, decompose
from mjx_cmaes.types import Costs, Flags, Matrix, Points, Vector

# Of the shrinkage of σ's path that mirrored pairs cause under random selection, the part that is undone. 1 is unbiased in
# R^n, but at a bound projection pushes the mean inwards and keeps σ large. Medians of 8 seeds at n = 84 for 0, 0.5, 1:
# sphere on bounds 2.5e-6, 5.8e-6, 2.4e-5; rotated ellipsoid inside 530, 489, 384; elsewhere much the same.
MIRROR_CORRECTION = 0.5
# Above this condition of the correlations the scales learn more slowly (D, beta_thresh).
CORRELATION_THRESHOLD = 2.0
SHRINK_WHEN_ALL_FAIL = 0.8
WIDEN_WHEN_ALL_TIE = 1.1
# From so many coordinates on, where a decomposition costs more than half of an update, it is made every MOST generations, or
# as often as C learns STALENESS. Medians of 16 seeds at n = 84 for every, every second, every third generation: sphere 7e-12,
# 10e-12, 8e-12; rotated ellipsoid 0.30, 0.33, 0.35; on bounds 0.030, 0.031, 0.025; Rosenbrock 3.200, 3.203, 3.202.
MANY = 60
MOST = 3
STALENESS = 0.05
# Floor of σ and of the scales: a collapsed distribution stays finite.
SMALLEST = 1e-100


@dataclass(frozen=True, eq=False)
class _Steps:
    """A generation in the distribution's own coordinates."""

    y: Points
    """(x - mean) / (σ scale), ~ N(0, C)."""
    z: Points
    """C^(-1/2) y, ~ N(0, I)."""
    lengths2: Costs
    """‖z‖² of each."""


def tell(settings: Settings, state: State, points: Points, costs: Costs) -> tuple[State, Info]:
    """The state after a generation whose `points` (population, n) cost `costs` (population,); lower is better.

    The points may differ from those that `ask` returned (`inject`). Costs that are not finite rank last and never
    attract the mean; tied costs share their weights. Where no cost is finite the distribution only shrinks; where
    all are equal it only widens.

    Raises ValueError where shapes do not fit or a point is not finite or outside the box.
    """
    points, costs = _checked(settings, state, points, costs)
    costs = failures_last(costs)
    injected = _injected(state, points)
    state = _record(state, points, costs)
    ranking = Ranking.of(costs)
    finite, distinct = ranking.finite, ranking.distinct
    if not finite.any():
        new = changed(state, sigma=state.sigma * SHRINK_WHEN_ALL_FAIL, failed=state.failed + 1, tied=0)
    elif distinct == 1 and finite.all():
        widened = state.sigma * min(WIDEN_WHEN_ALL_TIE, _room(settings, state))
        new = changed(state, sigma=widened, tied=state.tied + 1, failed=0)
    else:
        constants = parameters(settings.dimension, len(points), settings.diagonal_acceleration)
        steps = _whiten(state, points, injected if settings.injection_limit else None)
        new = _update(settings, changed(state, tied=0, failed=0), constants, steps, ranking)
    return new, _info(new, costs, distinct, int(injected.sum()))


def _update(settings: Settings, state: State, p: Parameters, steps: _Steps, ranking: Ranking) -> State:
    """Mean, paths, σ, C and S, in the tutorial's order."""
    attract = recombination_weights(p.positive, ranking)
    mean_y, mean_z = attract @ steps.y, attract @ steps.z  # (T 41)
    mean = state.mean + state.sigma * state.scale * mean_y  # (T 42), c_m = 1
    if settings.bounded:
        mean = np.clip(mean, 0.0, 1.0)  # a convex combination of points in the box: rounding only

    root_mu = math.sqrt(_selection_mass(settings, attract))
    age = state.age + 1
    path_sigma = _decay(state.path_sigma, p.c_sigma, root_mu * mean_z)  # (T 43)
    length = float(np.linalg.norm(path_sigma))
    growth = math.exp(min(1.0, p.c_sigma / p.d_sigma * (length / p.chi_n - 1)))  # (T 44)
    sigma = state.sigma * min(growth, _room(settings, state))
    gamma = 1 - (1 - p.c_sigma) ** (2 * (age + (p.diagonal is None)))
    stalled = length / math.sqrt(gamma) >= (1.4 + 2 / (settings.dimension + 1)) * p.chi_n  # h_σ, T p. 28
    pull = np.zeros_like(mean_y) if stalled else root_mu * state.scale * mean_y

    path_full = _decay(state.path_full, p.full.c_c, pull)  # (T 45)
    full_weight = _path_weight(state.path_full_weight, p.full, stalled, p.diagonal is None)
    covariance = _learn_covariance(state, p.full, steps, ranking, path_full / state.scale, full_weight)
    new = changed(
        state,
        age=age,
        mean=mean,
        sigma=max(sigma, SMALLEST),
        path_sigma=path_sigma,
        path_full=path_full,
        path_full_weight=full_weight,
        covariance=covariance,
    )
    if p.diagonal is not None:
        path = _decay(state.path_diagonal, p.diagonal.c_c, pull)
        weight = _path_weight(state.path_diagonal_weight, p.diagonal, stalled, False)
        scale = _learn_scale(state, p.diagonal, steps, ranking, path, weight)
        new = changed(new, scale=scale, path_diagonal=path, path_diagonal_weight=weight)
    return _decompose_if_due(new, p)


def _room(settings: Settings, state: State) -> float:
    """How much σ may still grow: in the box no coordinate needs a standard deviation above 1."""
    return max(1.0, 1.0 / state.std.max()) if settings.bounded else math.inf


def _decay(path: Vector, rate: float, step: Vector) -> Vector:
    """An evolution path that forgets at `rate` and keeps unit variance under random selection."""
    return (1 - rate) * path + math.sqrt(rate * (2 - rate)) * step


def _selection_mass(settings: Settings, attract: Costs) -> float:
    """μ_eff of the weights at hand (ties and failures change it), corrected for mirrored pairs.

    Under random selection the weighted mean of independent steps has variance Σw². In a pair ±z the weights subtract:
    the variance is Σw² - 2 Σ_pairs w_i w_j, whose expectation over permutations is Σw² - (1 - Σw²) / (λ - 1).
    """
    squares = float(attract @ attract)
    population = len(attract)
    if settings.mirrored:
        paired = MIRROR_CORRECTION * (1 - squares) / (population - 1)
        squares = max(squares - paired, 1 / population)
    return 1 / squares


def _path_weight(weight: float, rates: Rates, stalled: bool, plain: bool) -> float:
    """Expected squared length of the path over n (D, γ); the tutorial takes 1 - δ(h_σ) instead (T p. 28)."""
    grown = rates.c_c * (2 - rates.c_c)
    if plain:
        return 1 - stalled * grown
    return (1 - rates.c_c) ** 2 * weight + (not stalled) * grown


def _active(rates: Rates, steps: _Steps, ranking: Ranking) -> tuple[Costs, float]:
    """Weights w° with the negative ones scaled by n / ‖z‖² (T 46), and the sum of the weights before."""
    weights = rank_weights(rates.weights, ranking)
    n = steps.y.shape[1]
    shrink = n / np.maximum(steps.lengths2, 1e-8 * n)
    return np.where(weights >= 0, weights, weights * shrink), float(weights.sum())


def _learn_covariance(
    state: State, rates: Rates, steps: _Steps, ranking: Ranking, path: Vector, path_weight: float
) -> Matrix:
    """C after the rank-one and the rank-μ update (T 47)."""
    weights, total = _active(rates, steps, ranking)
    keep = 1 - rates.c_1 * path_weight - rates.c_mu * total
    rank_mu = (steps.y.T * weights) @ steps.y
    covariance = keep * state.covariance + rates.c_1 * np.outer(path, path) + rates.c_mu * rank_mu
    return (covariance + covariance.T) / 2


def _learn_scale(
    state: State, rates: Rates, steps: _Steps, ranking: Ranking, path: Vector, path_weight: float
) -> Vector:
    """Coordinates' scales after the multiplicative update (D, 3.2), slowed down where correlations are strong."""
    weights, total = _active(rates, steps, ranking)
    path_z = state.basis @ ((state.basis.T @ (path / state.scale)) / state.axes)
    change = rates.c_1 * (path_z**2 - path_weight) + rates.c_mu * (weights @ steps.z**2 - total)
    slow = max(1.0, state.axes.max() / state.axes.min() - CORRELATION_THRESHOLD + 1)
    return np.maximum(state.scale * np.exp(np.clip(change / (2 * slow), -1.0, 1.0)), SMALLEST)


def _decompose_if_due(state: State, p: Parameters) -> State:
    """Renews B and the axes every few generations (T, B.2), and makes C a correlation matrix again (D)."""
    learnt = p.full.c_1 + p.full.c_mu
    interval = max(1, min(MOST, int(STALENESS / learnt))) if len(state.mean) >= MANY else 1
    if state.decomposed + 1 < interval:
        return changed(state, decomposed=state.decomposed + 1)
    covariance, scale = state.covariance, state.scale
    if p.diagonal is not None:
        std = np.sqrt(np.diag(covariance))
        scale, covariance = scale * std, covariance / np.outer(std, std)
    basis, axes = decompose(covariance)
    return changed(state, covariance=covariance, scale=scale, basis=basis, axes=axes, decomposed=0)


def _whiten(state: State, points: Points, injected: Flags | None) -> _Steps:
    """Steps of the points; those of injected ones are shortened to √n + 2n/(n+2) standard deviations (Hansen 2011)."""
    y = (points - state.mean) / (state.sigma * state.scale)
    z = ((y @ state.basis) / state.axes) @ state.basis.T
    lengths2 = np.einsum("ij,ij->i", z, z)
    if injected is not None and injected.any():
        n = y.shape[1]
        limit = math.sqrt(n) + 2 * n / (n + 2)
        length = np.sqrt(lengths2)
        factor = np.where(injected & (length > limit), limit / np.maximum(length, limit), 1.0)
        y, z, lengths2 = y * factor[:, None], z * factor[:, None], lengths2 * factor**2
    return _Steps(y, z, lengths2)


def _injected(state: State, points: Points) -> Flags:
    """Which rows are not the ones that `ask` returned."""
    if state.asked.shape != points.shape:
        return np.ones(len(points), dtype=bool)
    return (points != state.asked).any(axis=1)


def _record(state: State, points: Points, costs: Costs) -> State:
    """Counts, the best point (the first of equals stays) and the recent best costs."""
    index = int(np.argmin(costs))
    better = costs[index] < state.best_cost
    return changed(
        state,
        generation=state.generation + 1,
        evaluations=state.evaluations + len(costs),
        best_x=points[index].copy() if better else state.best_x,
        best_cost=float(costs[index]) if better else state.best_cost,
        recent=np.append(state.recent[1:], costs[index]),
    )


def _info(state: State, costs: Costs, distinct: int, injected: int) -> Info:
    finite = np.sort(costs[np.isfinite(costs)])
    middle = finite[(len(finite) - 1) // 2 : len(finite) // 2 + 1]
    std = state.std
    return Info(
        generation=state.generation,
        evaluations=state.evaluations,
        best_cost=state.best_cost,
        generation_best=float(finite[0]) if len(finite) else math.inf,
        generation_median=float(middle.mean()) if len(finite) else math.inf,
        finite=len(finite),
        distinct=distinct,
        injected=injected,
        sigma=state.sigma,
        std_low=float(std.min()),
        std_high=float(std.max()),
        condition=condition(state),
    )


def condition(state: State) -> float:
    """Condition number of C, at the last decomposition."""
    return float((state.axes.max() / state.axes.min()) ** 2)


def _checked(settings: Settings, state: State, points: Points, costs: Costs) -> tuple[Points, Costs]:
    points, costs = np.array(points, dtype=np.float64), np.array(costs, dtype=np.float64)
    shape = (settings.population_after(state.restarts), settings.dimension)
    require(points.shape == shape, "points.shape", points.shape, f"{shape}")
    require(costs.shape == shape[:1], "costs.shape", costs.shape, f"({shape[0]},)")
    require(bool(np.isfinite(points).all()), "points", "a non-finite coordinate", "finite numbers")
    if settings.bounded:
        low, high = float(points.min()), float(points.max())
        require(low >= 0 and high <= 1, "points", f"range [{low:.6g}, {high:.6g}]", "every coordinate in [0, 1]")
    return points, costs
