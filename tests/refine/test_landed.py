"""Which landing the population search begins from."""

from __future__ import annotations

import numpy as np

from mjx_refine.search.landed import Landed, landed_well


def test_only_the_best_landing_counts():
    good = Landed(0, np.zeros(1), np.eye(1), fitness=0.9, iou=0.95)
    poor = Landed(1, np.zeros(1), np.eye(1), fitness=0.5, iou=0.99)
    assert landed_well([poor, good])
    assert not landed_well([Landed(0, np.zeros(1), np.eye(1), 0.95, 0.8), good])
    assert not landed_well([])
