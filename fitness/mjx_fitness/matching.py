"""Which simulated object is which observed mask, decided once for a whole clip."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from mjx_fitness.pictures import UNMATCHED


def match_costs(costs: Float[np.ndarray, "objects masks"], ids: list[int], limit: float = np.inf) -> tuple[int, ...]:
    """The assignment of least total cost (Hungarian algorithm; Kuhn 1955, as scipy's ``linear_sum_assignment``).

    Args:
      costs: of giving each object each mask; not finite where impossible.
      ids: the masks' ids.
      limit: pairs that cost more stay unmatched.

    Returns:
      for each object its mask's id, or ``UNMATCHED``.
    """
    # Imported here, because it takes half a second.
    from scipy.optimize import linear_sum_assignment

    costs = np.asarray(costs, np.float64)
    matching = [UNMATCHED] * costs.shape[0]
    if costs.size == 0:
        return tuple(matching)
    finite = np.isfinite(costs)
    impossible = 1e6 + np.abs(costs[finite]).sum() if finite.any() else 1e6
    for row, column in zip(*linear_sum_assignment(np.where(finite, costs, impossible)), strict=True):
        if finite[row, column] and costs[row, column] <= limit:
            matching[row] = ids[column]
    return tuple(matching)


def match_instances(
    masks: Int[np.ndarray, "frames height width"], observed_masks: Int[np.ndarray, "frames height width"], count: int
) -> tuple[int, ...]:
    """Matches objects 1..count to observed ids by their IoU over the whole clip, so that ids never swap within it.

    Objects that overlap no mask at all stay unmatched.
    """
    ids = [int(i) for i in np.unique(observed_masks) if i != 0]
    costs = np.full((count, len(ids)), np.inf)
    for n in range(count):
        simulated = masks == n + 1
        for j, i in enumerate(ids):
            observed = observed_masks == i
            both = np.count_nonzero(simulated & observed)
            if both:
                costs[n, j] = -both / np.count_nonzero(simulated | observed)
    return match_costs(costs, ids)
