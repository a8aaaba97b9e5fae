"""Weights and learning rates, from the dimension n and the population λ alone.

Equation numbers are those of Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv:1604.00772 (T), and of
Akimoto & Hansen, "Diagonal Acceleration for Covariance Matrix Adaptation Evolution Strategies", 2020,
arXiv:1905.05885 (D).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Rates:
    """How fast one part of the covariance learns."""

    c_c: float
    """Decay of its evolution path."""
    c_1: float
    """Rate of the rank-one update."""
    c_mu: float
    """Rate of the rank-μ update."""
    weights: Float[np.ndarray, " population"]
    """Recombination weights, best first, negative for the worse half; the positive ones sum to 1."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """All constants of the update."""

    population: int
    mu_eff: float
    chi_n: float
    """E‖N(0, I)‖."""
    c_sigma: float
    d_sigma: float
    positive: Float[np.ndarray, " population"]
    """The mean's weights: best first, >= 0, sum 1."""
    full: Rates
    """Of the correlations (or, without diagonal acceleration, of the whole covariance)."""
    diagonal: Rates | None
    """Of the coordinates' scales; None without diagonal acceleration."""


# In a few dimensions a large population would replace C outright, and points that projection makes equal would then
# leave it singular: C remembers at least this part's complement. Matters below 8 dimensions only.
FULL_RATE_LIMIT = 0.5


@lru_cache(maxsize=64)
def parameters(dimension: int, population: int, diagonal_acceleration: bool) -> Parameters:
    """The constants for n = `dimension` and λ = `population`."""
    n = dimension
    raw = math.log((population + 1) / 2) - np.log(np.arange(1, population + 1))  # (T 49)
    better, worse = np.maximum(raw, 0), np.maximum(-raw, 0)
    mu_eff = float(better.sum() ** 2 / (better**2).sum())  # (T 8)
    mu_eff_worse = float(worse.sum() ** 2 / (worse**2).sum())

    c_sigma = (mu_eff + 2) / (n + mu_eff + 5)  # (T 55)
    d_sigma = 1 + 2 * max(0.0, math.sqrt((mu_eff - 1) / (n + 1)) - 1) + c_sigma  # (T 55)

    def rates(c_c: float, c_1: float, c_mu: float) -> Rates:
        bound = min(
            1 + c_1 / c_mu if c_mu > 0 else math.inf,  # (T 50)
            1 + 2 * mu_eff_worse / (mu_eff + 2),  # (T 51)
            max(0.0, 1 - c_1 - c_mu) / (n * c_mu) if c_mu > 0 else math.inf,  # (T 52)
        )
        return Rates(c_c, c_1, c_mu, better / better.sum() - bound * worse / worse.sum())  # (T 53)

    if diagonal_acceleration:
        full = rates(*_accelerated(n, population, mu_eff, n * (n + 1) / 2, FULL_RATE_LIMIT))
        diagonal = rates(*_accelerated(n, population, mu_eff, n, 1.0))
    else:
        c_c = (4 + mu_eff / n) / (n + 4 + 2 * mu_eff / n)  # (T 56)
        c_1 = 2 / ((n + 1.3) ** 2 + mu_eff)  # (T 57)
        c_mu = min(1 - c_1, 2 * (mu_eff - 2 + 1 / mu_eff) / ((n + 2) ** 2 + mu_eff))  # (T 58)
        full, diagonal = rates(c_c, c_1, c_mu), None
    return Parameters(
        population=population,
        mu_eff=mu_eff,
        chi_n=math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n)),
        c_sigma=c_sigma,
        d_sigma=d_sigma,
        positive=better / better.sum(),
        full=full,
        diagonal=diagonal,
    )


def _accelerated(n: int, population: int, mu_eff: float, freedom: float, most: float) -> tuple[float, float, float]:
    """Path decay and learning rates for a part of the covariance with `freedom` degrees of freedom (D, 3.3)."""
    c_1 = 1 / (2 * (freedom / n + 1) * (n + 1) ** 0.75 + mu_eff / 2)
    mu = mu_eff + 1 / mu_eff - 2 + population / (2 * (population + 5))
    return math.sqrt(mu_eff * c_1) / 2, c_1, min(mu * c_1, most * (1 - c_1))
