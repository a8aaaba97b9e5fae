"""CMA-ES on the unit box: the population search, which knows only R^n.

Costs are MINIMISED. Functions are pure: `init` makes a `State`, `ask` draws points from it, `tell` turns their
costs into the next state, `should_stop` says why to end; `minimize` runs the whole loop.

>>> import numpy as np
>>> result = minimize(lambda x: ((x - 0.3) ** 2).sum(axis=1), np.array([0.9, 0.1]), 0.2, iterations=60, seed=1)
>>> np.round(result.best_x, 3).tolist(), result.best_cost < 1e-12
([0.3, 0.3], True)
"""

from mjx_cmaes.driver import Result, minimize
from mjx_cmaes.persist import load_state, save_state
from mjx_cmaes.sampling import ask, inject
from mjx_cmaes.settings import Settings
from mjx_cmaes.state import Info, State, init, restart
from mjx_cmaes.stopping import Reason, should_stop
from mjx_cmaes.strategy import tell

__all__ = [
    "Info",
    "Reason",
    "Result",
    "Settings",
    "State",
    "ask",
    "init",
    "inject",
    "load_state",
    "minimize",
    "restart",
    "save_state",
    "should_stop",
    "tell",
]
