"""Which parameters a clip does not determine, and putting those back to their start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.space import Space

INSENSITIVE = 0.002
"""Change of the fitness that one prior width of a parameter must reach for the clip to determine it."""

ALLOWED_LOSS = 0.001
"""Fitness that putting undetermined parameters back to their start may cost in all."""


def insensitive(
    space: Space, point: Float[np.ndarray, "dimension"], costs: Callable[[np.ndarray], np.ndarray]
) -> Bool[np.ndarray, "dimension"]:
    """Whether one prior width up and one down each change the cost by less than 0.002, parameter by parameter."""
    return unmoved(costs(around(space, point)))


def around(space: Space, point: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "points dimension"]:
    """The point, then one prior width up in each parameter, then down."""
    steps = np.diag(space.sigma)
    return np.clip(np.concatenate([point[None], point + steps, point - steps]), 0.0, 1.0)


def unmoved(costs: Float[np.ndarray, "points"]) -> Bool[np.ndarray, "dimension"]:
    """Which parameters hardly change the cost, by the costs of the points that ``around`` gives."""
    price = np.nan_to_num(costs, nan=1e9, posinf=1e9)
    change = np.abs(price[1:] - price[0]).reshape(2, -1)
    return (change < INSENSITIVE).all(0)


def back_to_start(
    space: Space,
    point: Float[np.ndarray, "dimension"],
    loose: Bool[np.ndarray, "dimension"],
    costs: Callable[[np.ndarray], np.ndarray],
) -> Float[np.ndarray, "dimension"]:
    """``point`` with the ``loose`` parameters at their start, as far as the cost allows it.

    All at once where that costs nothing; otherwise one after the other, so that two that act together do not both move.
    """
    start = space.start
    together = np.where(loose, start, point)
    price = costs(np.stack([point, together]))
    if price[1] <= price[0] + ALLOWED_LOSS:
        return together
    result, best = point.copy(), float(price[0])
    for j in np.nonzero(loose)[0]:
        trial = result.copy()
        trial[j] = start[j]
        if costs(trial[None])[0] <= best + ALLOWED_LOSS / 4:
            result = trial
    return result
