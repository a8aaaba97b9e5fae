"""The update against two other implementations: PyPI's `cmaes`, and a dense one written from the formulas."""

from dataclasses import replace

import mjx_cmaes.strategy
import numpy as np
import pytest
from mjx_cmaes import Settings, ask, init, tell
from mjx_cmaes.parameters import parameters
from mjx_cmaes.ranking import Ranking, rank_weights, recombination_weights
from mjx_cmaes.state import State
from scipy.linalg import sqrtm

import cmaes

OFFSET = np.array([0.3, -0.7, 1.1, 0.2, -0.4, 0.6])


def cost(points: np.ndarray) -> np.ndarray:
    return (3.0 ** np.arange(points.shape[1]) * (points - OFFSET[: points.shape[1]]) ** 2).sum(axis=1)


def whole_covariance(state: State) -> np.ndarray:
    return state.sigma**2 * state.covariance * np.outer(state.scale, state.scale)


@pytest.mark.parametrize(("dimension", "population"), [(2, 6), (6, 12), (6, 64)])
def test_plain_update_equals_cmaes(dimension, population):
    mean = np.full(dimension, 0.5)
    other = cmaes.CMA(mean=mean.copy(), sigma=0.4, population_size=population, seed=3)
    settings = Settings(
        dimension,
        population,
        bounded=False,
        mirrored=False,
        diagonal_acceleration=False,
        injection_limit=False,
    )
    state = init(settings, mean, 0.4)
    for _ in range(25):
        points = np.array([other.ask() for _ in range(population)])
        costs = cost(points)
        other.tell(list(zip(points, costs.tolist(), strict=True)))
        state, _ = tell(settings, state, points, costs)
        np.testing.assert_allclose(state.mean, other.mean, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(state.sigma, other._sigma, rtol=1e-6)
        expected = other._sigma**2 * other._C
        np.testing.assert_allclose(whole_covariance(state), expected, rtol=1e-5, atol=1e-6 * expected.max())


class Dense:
    """CMA-ES with diagonal decoding from its paper, matrices dense and square roots by scipy, no shortcuts."""

    def __init__(self, mean, std, population):
        n = len(mean)
        self.m, self.s, self.lam = mean, std, population
        self.C, self.D = np.eye(n), np.eye(n)
        self.root = np.eye(n)
        self.ps, self.pc, self.pd = np.zeros(n), np.zeros(n), np.zeros(n)
        self.gs = self.gc = self.gd = 0.0

    def tell(self, x, f):
        n, lam = len(self.m), self.lam
        order = np.argsort(f)
        raw = np.array([np.log((lam + 1) / 2) - np.log(i) for i in range(1, lam + 1)])
        mu = raw[raw > 0].sum() ** 2 / (raw[raw > 0] ** 2).sum()
        mu_minus = raw[raw < 0].sum() ** 2 / (raw[raw < 0] ** 2).sum()

        def rates(m, most):
            one = 1 / (2 * (m / n + 1) * (n + 1) ** 0.75 + mu / 2)
            several = min((mu + 1 / mu - 2 + lam / (2 * (lam + 5))) * one, most * (1 - one))
            alpha = min(1 + one / several, 1 + 2 * mu_minus / (mu + 2), (1 - one - several) / (n * several))
            w = np.where(raw > 0, raw / raw[raw > 0].sum(), alpha * raw / -raw[raw < 0].sum())
            return one, several, np.sqrt(mu * one) / 2, w

        c1, cm, cc, w = rates(n * (n + 1) / 2, 0.5)
        d1, dm, dc, wd = rates(n, 1.0)
        inverse = np.linalg.inv(self.root)
        y = [np.linalg.inv(self.D) @ (x[i] - self.m) / self.s for i in order]
        z = [inverse @ v for v in y]
        step = sum(w[i] * y[i] for i in range(lam) if w[i] > 0)
        cs = (mu + 2) / (n + mu + 5)
        ds = 1 + cs + 2 * max(0, np.sqrt((mu - 1) / (n + 1)) - 1)
        chi = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
        self.m = self.m + self.s * self.D @ step
        self.ps = (1 - cs) * self.ps + np.sqrt(cs * (2 - cs) * mu) * inverse @ step
        self.gs = (1 - cs) ** 2 * self.gs + cs * (2 - cs)
        h = float(np.linalg.norm(self.ps) / np.sqrt(self.gs) < (1.4 + 2 / (n + 1)) * chi)
        self.pc = (1 - cc) * self.pc + h * np.sqrt(cc * (2 - cc) * mu) * self.D @ step
        self.gc = (1 - cc) ** 2 * self.gc + h * cc * (2 - cc)
        self.pd = (1 - dc) * self.pd + h * np.sqrt(dc * (2 - dc) * mu) * self.D @ step
        self.gd = (1 - dc) ** 2 * self.gd + h * dc * (2 - dc)

        root, spread = self.root, np.linalg.eigvalsh(self.C)
        p = np.linalg.inv(self.D) @ self.pc
        C = self.C + c1 * (np.outer(p, p) - self.gc * self.C)
        p = np.linalg.inv(root) @ np.linalg.inv(self.D) @ self.pd
        change = d1 * (p**2 - self.gd)
        for i in range(lam):
            part = 1.0 if w[i] >= 0 else n / (z[i] @ z[i])
            C = C + cm * w[i] * (part * np.outer(y[i], y[i]) - self.C)
            change = change + dm * wd[i] * (part * z[i] ** 2 - 1)
        beta = max(1.0, np.sqrt(spread[-1] / spread[0]) - 1)
        D = self.D @ np.diag(np.exp(change / (2 * beta)))
        self.s *= np.exp(min(1.0, cs / ds * (np.linalg.norm(self.ps) / chi - 1)))
        # C to a correlation matrix, its standard deviations into D.
        std = np.diag(np.sqrt(np.diag(C)))
        self.C = np.linalg.inv(std) @ C @ np.linalg.inv(std)
        self.D = D @ std
        self.root = np.real(sqrtm(self.C))


def test_accelerated_update_equals_dense():
    n, population = 4, 12
    settings = Settings(n, population, bounded=False, mirrored=False)
    mean = np.array([0.1, 0.9, 0.4, 0.5])
    state, other = init(settings, mean, 0.3, seed=5), Dense(mean, 0.3, population)
    for _ in range(20):
        points, state = ask(settings, state)
        costs = cost(points)
        state, info = tell(settings, state, points, costs)
        other.tell(points, costs)
        assert info.injected == 0
        np.testing.assert_allclose(state.mean, other.m, rtol=1e-7)
        expected = other.s**2 * other.D @ other.C @ other.D
        np.testing.assert_allclose(whole_covariance(state), expected, rtol=1e-6, atol=1e-8 * expected.max())


def test_constants_at_a_known_case():
    # Tutorial table 1 for n = 10, λ = 10: μ_eff 3.17, c_σ 0.285, c_c 0.295, c_1 0.0153, c_μ 0.0202.
    p = parameters(10, 10, False)
    assert p.mu_eff == pytest.approx(3.1673, abs=1e-3)
    assert p.c_sigma == pytest.approx(0.2844, abs=1e-3)
    assert p.full.c_c == pytest.approx(0.2950, abs=1e-3)
    assert p.full.c_1 == pytest.approx(2 / (11.3**2 + p.mu_eff))
    assert p.positive.sum() == pytest.approx(1.0)


def test_sampling_is_standard_normal_and_mirrored():
    settings = Settings(3, 8, bounded=False)
    state = init(settings, np.zeros(3), 1.0)
    drawn = []
    for _ in range(1500):
        points, state = ask(settings, state)
        np.testing.assert_array_equal(points[:4], -points[4:])
        np.testing.assert_allclose(points[:3] @ points[:3].T, np.diag((points[:3] ** 2).sum(axis=1)), atol=1e-12)
        drawn.append(points[:4])
    for row in range(4):
        sample = np.array(drawn)[:, row]
        np.testing.assert_allclose(sample.mean(axis=0), 0, atol=5 / np.sqrt(1500))
        np.testing.assert_allclose(np.cov(sample.T), np.eye(3), atol=5 * np.sqrt(2 / 1500))
        np.testing.assert_allclose((sample**4).mean(axis=0), 3, atol=5 * np.sqrt(96 / 1500))


@pytest.mark.parametrize(
    ("mirrored", "correction", "most"),
    # Converging searches change σ by 20 % a generation. The full correction is unbiased, ours half of it (see there).
    [(False, 0.5, 0.015), (True, 1.0, 0.015), (True, 0.5, 0.04)],
)
def test_random_ranks_hardly_move_sigma(monkeypatch, mirrored, correction, most):
    monkeypatch.setattr(mjx_cmaes.strategy, "MIRROR_CORRECTION", correction)
    settings = Settings(20, 128, bounded=False, mirrored=mirrored)
    state, generator = init(settings, np.zeros(20), 1.0), np.random.default_rng(0)
    for _ in range(100):
        points, state = ask(settings, state)
        state, _ = tell(settings, state, points, generator.random(128))
    drift = np.log(np.linalg.eigvalsh(whole_covariance(state))).mean() / 2 / 100
    assert abs(drift) < most


def test_tied_costs_share_their_weights():
    weights = np.array([0.5, 0.3, 0.2, 0.0, -0.4, -0.6])
    shares = rank_weights(weights, Ranking.of(np.array([2.0, 1.0, 2.0, 5.0, 5.0, 5.0])))
    np.testing.assert_allclose(shares, [0.25, 0.5, 0.25, -1 / 3, -1 / 3, -1 / 3])
    assert shares.sum() == pytest.approx(weights.sum())


def test_failures_never_attract():
    shares = recombination_weights(np.array([0.6, 0.3, 0.1, 0.0]), Ranking.of(np.array([np.inf, np.inf, 3.0, np.inf])))
    np.testing.assert_allclose(shares, [0, 0, 1, 0])


def test_ties_do_not_depend_on_the_order_of_points():
    settings = Settings(4, 16)
    points, state = ask(settings, init(settings, np.full(4, 0.5), 0.2))
    costs = np.floor(points.sum(axis=1) * 3)
    assert len(np.unique(costs)) < 10
    order = np.random.default_rng(0).permutation(16)
    first, _ = tell(settings, state, points, costs)
    # asked is permuted too, so that no row counts as injected.
    second, _ = tell(settings, replace(state, asked=points[order]), points[order], costs[order])
    np.testing.assert_allclose(first.mean, second.mean, rtol=1e-12)
    np.testing.assert_allclose(first.covariance, second.covariance, rtol=1e-9, atol=1e-12)
    assert first.sigma == pytest.approx(second.sigma, rel=1e-12)


def test_injected_points_are_limited():
    settings = Settings(5, 16)
    state = init(settings, np.full(5, 0.2), 0.01)
    points, state = ask(settings, state)
    far = points.copy()
    far[-1] = 1.0
    costs = np.arange(16.0)
    costs[-1] = -1.0
    new, info = tell(settings, state, far, costs)
    assert info.injected == 1
    assert new.best_cost == -1
    np.testing.assert_array_equal(new.best_x, far[-1])
    limit = 0.01 * (np.sqrt(5) + 10 / 7)
    assert np.linalg.norm(new.mean - state.mean) <= limit
    free, _ = tell(Settings(5, 16, injection_limit=False), state, far, costs)
    assert np.linalg.norm(free.mean - state.mean) > 5 * limit


def test_full_covariance_is_what_is_sampled():
    generator = np.random.default_rng(2)
    root = generator.standard_normal((3, 3))
    covariance = 1e-4 * (root @ root.T + 0.1 * np.eye(3))
    settings = Settings(3, 3000)
    state = init(settings, np.full(3, 0.5), covariance=covariance)
    np.testing.assert_allclose(whole_covariance(state), covariance, rtol=1e-12)
    points, _ = ask(settings, state)
    np.testing.assert_allclose(np.cov(points.T), covariance, atol=0.12 * covariance.max())
    np.testing.assert_allclose(state.std, np.sqrt(np.diag(covariance)))
