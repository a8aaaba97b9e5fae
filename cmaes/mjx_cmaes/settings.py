"""What the caller chooses, checked once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


def require(condition: bool, name: str, value: object, expectation: str) -> None:
    """Raises ValueError that names the argument, its value and what was expected."""
    if not condition:
        raise ValueError(f"{name} = {value!r}; expected {expectation}")


def _is_count(value: object, least: int) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= least)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


@dataclass(frozen=True)
class Settings:
    """Choices of a search; the defaults are tuned for population 128 and about 100 generations.

    Raises ValueError (argument, value, expectation) where a choice makes no sense.
    """

    dimension: int
    """Number of coordinates n, >= 1."""
    population: int = 128
    """Points a generation, >= 4."""
    bounded: bool = True
    """Keep points in [0, 1]^n. False searches all of R^n."""
    diagonal_acceleration: bool = True
    """Learn the coordinates' scales apart from, and faster than, their correlations (Akimoto & Hansen 2020).
    False gives the tutorial's update."""
    mirrored: bool = True
    """Draw points in pairs mean ± step, the steps of a block mutually orthogonal. False draws independently."""
    injection_limit: bool = True
    """Shorten the steps of points that `ask` did not return (Hansen 2011)."""
    population_growth: float = 1.0
    """Factor on the population at each restart, >= 1; 2 is IPOP. 1 keeps the batch's shape (no recompilation)."""
    restart_at: str = "best"
    """Where a restart begins: "best" (the best point known, half the initial width) or "uniform" (anywhere in the
    box, full initial width)."""
    max_evaluations: int | None = None
    """Stop once this many points were told; None: no limit."""
    target: float = -math.inf
    """Stop once a cost is at or below this."""
    tolerance_x: float = 1e-11
    """Stop once every coordinate's standard deviation is below this (box units)."""
    tolerance_cost: float = 1e-12
    """Stop once the generations' best costs of the recent past lie within this. 0 never stops for it."""
    condition_limit: float = 1e13
    """Stop once the condition number of C exceeds this. With diagonal acceleration C holds the correlations alone:
    scales that differ, as of a coordinate that rests on a bound, are no harm."""
    patience: int = 10
    """Stop after this many generations in a row in which all costs were equal, or none was finite."""

    def __post_init__(self) -> None:
        require(_is_count(self.dimension, 1), "dimension", self.dimension, "a whole number >= 1")
        require(_is_count(self.population, 4), "population", self.population, "a whole number >= 4")
        require(_is_count(self.patience, 1), "patience", self.patience, "a whole number >= 1")
        growth = self.population_growth
        require(_is_number(growth) and 1 <= growth <= 10, "population_growth", growth, "1 <= growth <= 10")
        require(self.restart_at in ("best", "uniform"), "restart_at", self.restart_at, '"best" or "uniform"')
        require(
            self.restart_at != "uniform" or self.bounded, "restart_at", self.restart_at, '"best" where bounded is False'
        )
        limit = self.max_evaluations
        require(limit is None or _is_count(limit, 1), "max_evaluations", limit, "None or a whole number >= 1")
        require(
            _is_number(self.target) and not math.isnan(self.target), "target", self.target, "a number that is not NaN"
        )
        for name in ("tolerance_x", "tolerance_cost"):
            value = getattr(self, name)
            require(_is_number(value) and 0 <= value < math.inf, name, value, "a finite number >= 0")
        limit = self.condition_limit
        require(_is_number(limit) and limit > 1, "condition_limit", limit, "a number > 1")

    def population_after(self, restarts: int) -> int:
        """Points a generation after that many restarts."""
        return int(self.population * self.population_growth**restarts)

    @property
    def history_length(self) -> int:
        """Generations whose best costs `tolerance_cost` compares: 10 + ⌈30 n / λ⌉ (tutorial, B.3 TolFun)."""
        return 10 + math.ceil(30 * self.dimension / self.population)
