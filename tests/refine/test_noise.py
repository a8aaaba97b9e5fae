"""Correlations of residuals: measured where they are, and worth fewer measurements."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_refine.search.noise import EDGE_FLOOR, SIMULATED, measured, unmeasured

FRAMES, DIRECTIONS, POINTS = 40, 16, 12


def _pixels(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(0, 40, (FRAMES, 1, POINTS, 2))


def _smooth(rng: np.random.Generator, pixels: np.ndarray, share: float, length: float) -> np.ndarray:
    """Flow errors (T, 1, 2 P) of unit variance with a smooth part."""
    squared = ((pixels[:, :, :, None] - pixels[:, :, None]) ** 2).sum(-1)
    covariance = share * np.exp(-squared / (2 * length**2)) + (1 - share) * np.eye(POINTS)
    error = np.linalg.cholesky(covariance) @ rng.standard_normal((FRAMES, 1, POINTS, 2))
    return error.reshape(FRAMES, 1, 2 * POINTS)


@pytest.mark.parametrize(("share", "length"), [(0.0, 8.0), (0.3, 16.0), (0.8, 16.0), (0.9, 64.0)])
def test_flow_is_whitened(share: float, length: float):
    rng = np.random.default_rng(1)
    pixels = _pixels(rng)
    noise = measured(rng.standard_normal((FRAMES, 1, DIRECTIONS)), _smooth(rng, pixels, share, length), pixels)
    again = np.concatenate([_smooth(rng, pixels, share, length) for _ in range(50)], 1)
    white = (noise.whitener @ again.reshape(FRAMES, 50, POINTS, 2)).reshape(FRAMES, 50, POINTS, 2)
    # A sum over points tells whether they are counted as independent.
    weights = np.array([noise.whitener[t, 0] @ np.ones(POINTS) for t in range(FRAMES)])
    mean = np.einsum("tp,tnpc->tnc", weights, white) / (weights**2).sum(-1)[:, None, None]
    claimed = np.sqrt((1 / (weights**2).sum(-1)).mean())
    assert mean.std() == pytest.approx(claimed, rel=0.35)
    naive = 1 / np.sqrt(POINTS)
    assert (claimed > 1.8 * naive) == (share > 0.5)


def test_an_edge_that_repeats_counts_once():
    rng = np.random.default_rng(2)
    flow, pixels = np.full((FRAMES, 1, 0), np.nan), np.zeros((FRAMES, 1, 0, 2))
    moving = rng.standard_normal((FRAMES, 1, DIRECTIONS))
    resting = np.repeat(rng.standard_normal((1, 1, DIRECTIONS)), FRAMES, 0)
    apart, alike = measured(moving, flow, pixels), measured(resting, flow, pixels)
    assert apart.edge.mean() == pytest.approx(1.0, rel=0.2)
    # Forty frames that are the same tell what one tells; autocorrelations are summed over half of them.
    assert (alike.edge / alike.told[0]).mean() > 0.7 * np.sqrt(FRAMES * 0.75)


def test_deviations_follow_a_fit_that_is_lost_half_way():
    rng = np.random.default_rng(3)
    reach = 0.3 * rng.standard_normal((FRAMES, 1, DIRECTIONS))
    reach[FRAMES // 2 :] *= 10
    noise = measured(reach, np.full((FRAMES, 1, 0), np.nan), np.zeros((FRAMES, 1, 0, 2)))
    assert noise.edge[: FRAMES // 2 - 5].mean() == pytest.approx(0.3, rel=0.2)
    assert noise.edge[FRAMES // 2 + 5 :].mean() == pytest.approx(3.0, rel=0.2)


def test_nothing_seen_and_nothing_wrong():
    blank = measured(np.full((3, 2, DIRECTIONS), np.nan), np.full((3, 2, 24), np.nan), np.zeros((3, 2, POINTS, 2)))
    np.testing.assert_array_equal(blank.edge, np.ones((3, 2)))
    exact = measured(np.zeros((9, 1, DIRECTIONS)), np.zeros((9, 1, 24)), np.zeros((9, 1, POINTS, 2)))
    np.testing.assert_array_equal(exact.edge, np.full((9, 1), EDGE_FLOOR))


def test_scatter_of_simulations_is_whitened():
    rng = np.random.default_rng(4)
    noise = unmeasured(5, 1, DIRECTIONS, 0)
    size, scale = 5 * DIRECTIONS, np.array([9.0, 4.0])
    bundle = np.linalg.qr(rng.standard_normal((size, 2)))[0].T
    told = noise.with_scatter(rng.standard_normal((400, 2)) * scale @ bundle)
    # Clip and simulation scatter alike, and pixels add a unit.
    apart = np.sqrt(SIMULATED) * rng.standard_normal((4000, 2)) * scale @ bundle + rng.standard_normal((4000, size))
    deviations = (told.settled(apart) @ bundle.T).std(0)
    np.testing.assert_allclose(deviations, 1.0, rtol=0.1)
    across = rng.standard_normal(size)
    across -= bundle.T @ (bundle @ across)
    np.testing.assert_allclose(told.settled(across[None])[0], across, atol=1e-9)
