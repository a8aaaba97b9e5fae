"""How far around a landing the population search begins."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_refine.search.landed import LOSS, WIDTHS, Landed, fitting_width, landed_well


@pytest.mark.parametrize("steepness", [0.0, 1.0, 30.0, 1e6])
def test_the_widest_whose_draws_lose_little(steepness):
    mean, covariance = np.full(5, 0.5), 1e-4 * np.eye(5)
    factor, spent = fitting_width(lambda x: steepness * ((x - 0.5) ** 2).sum(1), mean, covariance, seed=3)
    assert factor in WIDTHS
    assert spent == 41
    draws = np.random.default_rng(0).standard_normal((4000, 5)) * 0.01
    lost = np.median(steepness * (draws**2).sum(1)) * WIDTHS**2
    allowed = [w for w, loss in zip(WIDTHS, lost, strict=True) if loss < LOSS] or [WIDTHS[-1]]
    assert abs(np.log2(factor / allowed[0])) <= 1  # ten draws tell it to about one width


def test_candidates_that_diverge_lose_all():
    costs = lambda x: np.where(np.abs(x - 0.5).max(1) > 0.004, np.nan, 0.0)  # noqa: E731
    factor, _ = fitting_width(costs, np.full(3, 0.5), 1e-4 * np.eye(3), seed=0)
    assert factor < 0.5


def test_only_the_best_landing_counts():
    good = Landed(0, np.zeros(1), np.eye(1), fitness=0.9, iou=0.95)
    poor = Landed(1, np.zeros(1), np.eye(1), fitness=0.5, iou=0.99)
    assert landed_well([poor, good])
    assert not landed_well([Landed(0, np.zeros(1), np.eye(1), 0.95, 0.8), good])
    assert not landed_well([])
