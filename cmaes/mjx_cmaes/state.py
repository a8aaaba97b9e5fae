"""The search's whole memory, and how it begins."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mjx_cmaes.settings import Settings, require
from mjx_cmaes.types import Matrix, Vector


@dataclass(frozen=True, eq=False)
class State:
    """Everything the next generation depends on.

    Points are drawn from N(mean, σ² S C S), S = diag(scale). Randomness is a function of (seed, draws): there is no
    hidden generator, so that a saved state goes on bit for bit.
    """

    seed: int
    draws: int
    """How often `ask` drew from this seed."""
    generation: int
    """Generations told, restarts included."""
    restarts: int
    evaluations: int
    """Points told."""
    mean: Vector
    sigma: float
    """Overall step size σ, box units."""
    scale: Vector
    """Coordinates' scales, diag(S)."""
    covariance: Matrix
    """C: about a correlation matrix (with diagonal acceleration)."""
    basis: Matrix
    """Eigenvectors B of C, by column, at the last decomposition."""
    axes: Vector
    """Square roots of C's eigenvalues at the last decomposition."""
    path_sigma: Vector
    path_full: Vector
    path_diagonal: Vector
    path_full_weight: float
    """Expected squared length of path_full over n: 0 before the first step, towards 1."""
    path_diagonal_weight: float
    age: int
    """Generations since the last (re)start."""
    decomposed: int
    """Generations since the last decomposition."""
    asked: Float[np.ndarray, "population dimension"]
    """The points that the last `ask` returned; empty (0, n) before it."""
    best_x: Vector
    best_cost: float
    """Lowest finite cost told, inf before one."""
    recent: Float[np.ndarray, " history"]
    """Best costs of the last generations, newest last; inf where none was finite or there was none."""
    tied: int
    """Generations in a row in which all costs were equal."""
    failed: int
    """Generations in a row in which no cost was finite."""
    initial_covariance: Matrix
    """Covariance of the very first distribution; restarts return to it."""

    @property
    def std(self) -> Vector:
        """Standard deviation of each coordinate of the current distribution, box units, shape (n,)."""
        return self.sigma * self.scale * np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class Info:
    """Diagnostics of one generation."""

    generation: int
    evaluations: int
    best_cost: float
    """Best so far."""
    generation_best: float
    """Lowest finite cost of this generation; inf where there was none."""
    generation_median: float
    """Median of the finite costs; inf where there was none."""
    finite: int
    """Number of finite costs."""
    distinct: int
    """Number of different finite costs."""
    injected: int
    """Points that differ from what `ask` returned."""
    sigma: float
    std_low: float
    std_high: float
    """Smallest and largest standard deviation of a coordinate, box units."""
    condition: float
    """Condition number of C (with diagonal acceleration: of the correlations)."""


def changed(state: State, **fields: object) -> State:
    """``dataclasses.replace``, which calls ``__init__`` with all fields, in a fifth of its time."""
    new = object.__new__(State)
    vars(new).update(vars(state), **fields)
    return new


def init(
    settings: Settings,
    mean: Vector,
    std: float | Vector | None = None,
    covariance: Matrix | None = None,
    seed: int = 0,
) -> State:
    """The state before the first generation.

    mean: the start, shape (n,), in the unit box where the search is bounded.
    std: initial standard deviation, box units: a number or one a coordinate, shape (n,).
    covariance: full initial covariance, box units squared, shape (n, n), symmetric positive definite; INSTEAD of `std`
    (then None): for instance the inverse of a Gauss-Newton matrix.

    Raises ValueError that names the argument, what it got and what it expected.
    """
    n = settings.dimension
    mean = _vector("mean", mean, n)
    if settings.bounded:
        outside = (mean < 0) | (mean > 1)
        require(not outside.any(), "mean", _first(mean, outside), "every coordinate in [0, 1]")
    require(isinstance(seed, int | np.integer) and 0 <= seed < 2**63, "seed", seed, "a whole number in [0, 2^63)")
    require((std is None) != (covariance is None), "std, covariance", (std, covariance), "exactly one of the two")
    full = _covariance(covariance, n) if covariance is not None else _diagonal(std, n)
    fields = _distribution(full, 1.0)
    return State(
        seed=int(seed),
        draws=0,
        generation=0,
        restarts=0,
        evaluations=0,
        mean=mean,
        asked=np.zeros((0, n)),
        best_x=mean,
        best_cost=math.inf,
        recent=np.full(settings.history_length, math.inf),
        initial_covariance=full,
        **fields,
    )


def restart(settings: Settings, state: State) -> State:
    """A fresh distribution that keeps the best point and the counts (`settings.restart_at` says where)."""
    if settings.restart_at == "uniform":
        # A stream of its own, so that no draw of `ask` is repeated.
        mean = np.random.default_rng([state.seed, state.draws, 1]).random(settings.dimension)
        width = 1.0
    else:
        mean, width = state.best_x, 0.5
    return changed(
        state,
        restarts=state.restarts + 1,
        mean=mean,
        asked=np.zeros((0, settings.dimension)),
        recent=np.full(settings.history_length, math.inf),
        **_distribution(state.initial_covariance, width),
    )


def decompose(covariance: Matrix) -> tuple[Matrix, Vector]:
    """Eigenvectors B and the square roots of the eigenvalues of a symmetric matrix, floored above zero."""
    values, basis = np.linalg.eigh(covariance)
    return basis, np.sqrt(np.maximum(values, 1e-14 * max(values[-1], 1e-300)))


def _distribution(full: Matrix, width: float) -> dict:
    """σ, S, C and empty paths for a covariance, its standard deviations multiplied by `width`."""
    n = len(full)
    std = np.sqrt(np.diag(full))
    sigma = float(np.exp(np.mean(np.log(std))))
    correlation = full / np.outer(std, std)
    basis, axes = decompose(correlation)
    return {
        "sigma": sigma * width,
        "scale": std / sigma,
        "covariance": correlation,
        "basis": basis,
        "axes": axes,
        "path_sigma": np.zeros(n),
        "path_full": np.zeros(n),
        "path_diagonal": np.zeros(n),
        "path_full_weight": 0.0,
        "path_diagonal_weight": 0.0,
        "age": 0,
        "decomposed": 0,
        "tied": 0,
        "failed": 0,
    }


def _vector(name: str, value: object, n: int) -> Vector:
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} = {value!r}; expected {n} numbers") from error
    require(vector.shape == (n,), f"{name}.shape", vector.shape, f"({n},)")
    require(bool(np.isfinite(vector).all()), name, _first(vector, ~np.isfinite(vector)), "finite numbers")
    return vector


def _diagonal(std: object, n: int) -> Matrix:
    vector = _vector("std", np.full(n, std) if np.ndim(std) == 0 else std, n)  # type: ignore[arg-type]
    require(bool((vector > 0).all()), "std", _first(vector, vector <= 0), "every standard deviation > 0")
    return np.diag(vector**2)


def _covariance(covariance: object, n: int) -> Matrix:
    matrix = np.array(covariance, dtype=np.float64)
    require(matrix.shape == (n, n), "covariance.shape", matrix.shape, f"({n}, {n})")
    require(bool(np.isfinite(matrix).all()), "covariance", "a non-finite entry", "finite numbers")
    scale = float(np.abs(matrix).max())
    gap = float(np.abs(matrix - matrix.T).max())
    require(gap <= 1e-8 * scale, "covariance", f"asymmetric by {gap:.3g}", "a symmetric matrix")
    matrix = (matrix + matrix.T) / 2
    least = float(np.linalg.eigvalsh(matrix)[0])
    require(least > 1e-14 * scale, "covariance", f"smallest eigenvalue {least:.3g}", "a positive definite matrix")
    return matrix


def _first(values: Vector, wrong: Bool[np.ndarray, " dimension"]) -> str:
    """The first offending entry, with its index, for messages."""
    index = int(np.argmax(wrong))
    return f"{values[index]:.6g} at index {index}"
