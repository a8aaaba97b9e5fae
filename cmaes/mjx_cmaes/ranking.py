"""From costs to weights."""

from __future__ import annotations

import numpy as np

from mjx_cmaes.types import Costs, Weights


def rank_weights(weights: Weights, costs: Costs) -> Weights:
    """Each point's weight, shape (population,): `weights` is best first, tied costs share the average of theirs.

    >>> rank_weights(np.array([0.5, 0.3, 0.2]), np.array([7.0, 1.0, 7.0])).tolist()
    [0.25, 0.5, 0.25]
    """
    _, group, sizes = np.unique(costs, return_inverse=True, return_counts=True)
    ends = np.cumsum(sizes)
    sums = np.concatenate([[0.0], np.cumsum(weights)])
    return ((sums[ends] - sums[ends - sizes]) / sizes)[group]


def recombination_weights(weights: Weights, costs: Costs) -> Weights:
    """The mean's weights: as `rank_weights`, but a cost of inf (a failure) never attracts; they sum to 1.

    At least one cost must be finite.
    """
    shares = np.where(np.isfinite(costs), rank_weights(weights, costs), 0.0)
    total = shares.sum()
    # Fewer finite costs than positive weights is fine; ties across all weights still leave a positive sum.
    return shares / total


def failures_last(costs: Costs) -> Costs:
    """Costs with every value that is not finite (NaN, inf, -inf) replaced by inf, so that it ranks last."""
    return np.where(np.isfinite(costs), costs, np.inf)
