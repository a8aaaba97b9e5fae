"""Why a search ends."""

from __future__ import annotations

import enum

import numpy as np

from mjx_cmaes.settings import Settings
from mjx_cmaes.state import State
from mjx_cmaes.strategy import condition


class Reason(enum.Enum):
    """Reasons for stopping; the value is a sentence for a report."""

    TARGET = "The target cost was reached."
    BUDGET = "The budget of evaluations is spent."
    FAILED = "No cost was finite for several generations."
    ALL_TIED = "All costs were equal for several generations: the cost does not depend on the search here."
    TOLERANCE_X = "The search has contracted to a point: every standard deviation is below the tolerance."
    TOLERANCE_COST = "The best costs of the recent generations differ by less than the tolerance."
    ILL_CONDITIONED = "The covariance is too ill-conditioned for further progress."

    def __str__(self) -> str:
        return self.value

    @property
    def final(self) -> bool:
        """Whether a restart cannot help."""
        return self in (Reason.TARGET, Reason.BUDGET)


def should_stop(settings: Settings, state: State) -> Reason | None:
    """The first reason for stopping that holds, or None."""
    recent = state.recent
    full = state.age >= len(recent) and bool(np.isfinite(recent).all())
    limit = settings.max_evaluations
    checks = (
        (state.best_cost <= settings.target, Reason.TARGET),
        (limit is not None and state.evaluations >= limit, Reason.BUDGET),
        (state.failed >= settings.patience, Reason.FAILED),
        (state.tied >= settings.patience, Reason.ALL_TIED),
        (bool((state.std < settings.tolerance_x).all()), Reason.TOLERANCE_X),
        (settings.tolerance_cost > 0 and full and np.ptp(recent) <= settings.tolerance_cost, Reason.TOLERANCE_COST),
        (condition(state) > settings.condition_limit, Reason.ILL_CONDITIONED),
    )
    return next((reason for holds, reason in checks if holds), None)
