"""The whole loop, with the start evaluated and kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mjx_cmaes.sampling import ask, inject
from mjx_cmaes.settings import Settings, require
from mjx_cmaes.state import Info, State, init, restart
from mjx_cmaes.stopping import Reason, should_stop
from mjx_cmaes.strategy import tell
from mjx_cmaes.types import Costs, Matrix, Points, Vector


@dataclass(frozen=True, eq=False)
class Result:
    """What a search found."""

    best_x: Vector
    best_cost: float
    """Never above the start's; inf where no cost was finite (then `best_x` is the start)."""
    reason: Reason
    evaluations: int
    history: tuple[Info, ...]
    """One entry a generation of this call."""
    state: State
    """To go on from."""


def minimize(
    function: Callable[[Points], Costs],
    mean: Vector,
    std: float | Vector | None = None,
    *,
    covariance: Matrix | None = None,
    settings: Settings | None = None,
    iterations: int = 100,
    seed: int = 0,
    restarts: int = 0,
    given: Float[np.ndarray, "given dimension"] | None = None,
    callback: Callable[[State, Info], bool | None] | None = None,
    state: State | None = None,
) -> Result:
    """Minimises `function` from `mean`; never returns worse than `mean`, which the first generation contains.

    function: maps points (population, n) to costs (population,); always called with a full generation.
    mean, std, covariance, seed: as in `init`.
    settings: default `Settings(len(mean))`.
    iterations: generations in all, >= 1, those behind `state` included.
    restarts: how often to begin anew after a reason that more search may cure (`Settings.restart_at`).
    given: further points for the first generation, shape (k, n), k < population.
    callback: called after each generation with the state to go on from; returning True ends the search (BUDGET).
    state: goes on from here instead of starting: then `mean` and the like are not used.

    Raises ValueError as `Settings` and `init` do.

    >>> result = minimize(lambda x: np.abs(x).sum(axis=1), np.array([0.4, 0.6]), 0.2, iterations=20)
    >>> result.best_x.tolist(), str(result.reason)
    ([0.0, 0.0], 'The best costs of the recent generations differ by less than the tolerance.')
    """
    settings = Settings(len(mean)) if settings is None else settings
    require(iterations >= 1, "iterations", iterations, "a whole number >= 1")
    require(restarts >= 0, "restarts", restarts, "a whole number >= 0")
    if state is None:
        state = init(settings, mean, std, covariance, seed)
    history: list[Info] = []
    reason = None
    if state.generation > 0:
        state, reason = _proceed(settings, state, iterations, restarts)
    while reason is None:
        points, state = ask(settings, state)
        if state.generation == 0:
            points = inject(points, _first_points(state.mean, given))
        state, info = tell(settings, state, points, function(points))
        history.append(info)
        state, reason = _proceed(settings, state, iterations, restarts)
        if callback is not None and callback(state, info) and reason is None:
            reason = Reason.BUDGET
    return Result(state.best_x, state.best_cost, reason, state.evaluations, tuple(history), state)


def _proceed(settings: Settings, state: State, iterations: int, restarts: int) -> tuple[State, Reason | None]:
    """Why to stop here, or None; a restart where one helps and is left."""
    reason = should_stop(settings, state)
    if state.generation >= iterations and reason is not Reason.TARGET:
        reason = Reason.BUDGET
    if reason is not None and not reason.final and state.restarts < restarts:
        return restart(settings, state), None
    return state, reason


def _first_points(start: Vector, given: Float[np.ndarray, "given dimension"] | None) -> np.ndarray:
    """The start, which wins ties with all others, and the given points after it."""
    if given is None:
        return start[None]
    given = np.atleast_2d(np.asarray(given, dtype=np.float64))
    require(given.shape[1:] == start.shape, "given.shape", given.shape, f"(k, {len(start)})")
    return np.concatenate([start[None], given])
