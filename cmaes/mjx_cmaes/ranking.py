"""From costs to weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from mjx_cmaes.types import Costs, Flags, Weights


@dataclass(frozen=True, eq=False)
class Ranking:
    """A generation in order: points of equal cost are one group. Sorted once, used by every set of weights."""

    group: Int[np.ndarray, " population"]
    """Each point's group, cheapest first."""
    ends: Int[np.ndarray, " groups"]
    """How many points are in it or in a cheaper one."""
    sizes: Int[np.ndarray, " groups"]
    finite: Flags
    """Which costs are."""

    @classmethod
    def of(cls, costs: Costs) -> Ranking:
        """The order of costs, of which inf may be one."""
        _, group, sizes = np.unique(costs, return_inverse=True, return_counts=True)
        return cls(group, np.cumsum(sizes), sizes, np.isfinite(costs))

    @property
    def distinct(self) -> int:
        """Number of different finite costs."""
        return len(self.sizes) - (not self.finite.all())


def rank_weights(weights: Weights, ranking: Ranking) -> Weights:
    """Each point's weight, shape (population,): `weights` is best first, tied costs share the average of theirs.

    >>> rank_weights(np.array([0.5, 0.3, 0.2]), Ranking.of(np.array([7.0, 1.0, 7.0]))).tolist()
    [0.25, 0.5, 0.25]
    """
    sums = np.concatenate([[0.0], np.cumsum(weights)])
    return ((sums[ranking.ends] - sums[ranking.ends - ranking.sizes]) / ranking.sizes)[ranking.group]


def recombination_weights(weights: Weights, ranking: Ranking) -> Weights:
    """The mean's weights: as `rank_weights`, but a cost of inf (a failure) never attracts; they sum to 1.

    At least one cost must be finite.
    """
    shares = np.where(ranking.finite, rank_weights(weights, ranking), 0.0)
    total = shares.sum()
    # Fewer finite costs than positive weights is fine; ties across all weights still leave a positive sum.
    return shares / total


def failures_last(costs: Costs) -> Costs:
    """Costs with every value that is not finite (NaN, inf, -inf) replaced by inf, so that it ranks last."""
    return np.where(np.isfinite(costs), costs, np.inf)
