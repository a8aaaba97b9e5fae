"""Least squares of a hypothesis on one clip's measurements: robust, with a standard normal prior, and its evidence."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.diagnosis.hypothesis import Hypothesis
from mjx_refine.diagnosis.measure import Measured
from mjx_refine.diagnosis.predict import Prediction, Predictor
from mjx_refine.diagnosis.slack import Slack, impacts, kicked, slack_of
from mjx_refine.search.features import DIRECTIONS
from mjx_refine.search.landing import slowed
from mjx_refine.sim.backends import Simulator

EDGE_COUNT, FLOW_COUNT, BACKGROUND_COUNT = 6.0, 3.0, 6.0
"""As how many independent numbers the directions of one outline, the flow of one mask (each axis) and that of the
background (each axis) count in one frame, since neighbours err together; the first two until they are measured."""

EDGE_COUNTS, FLOW_COUNTS = (4.0, 12.0), (1.5, 10.0)
"""Bounds of these counts where they are measured."""

STEP, EFFECT_STEP = 0.4, 0.1
"""Of finite differences, in prior widths: of base parameters and of effects'."""

TAIL = 2.0
"""Prior widths beyond which moving a base parameter costs ever less: half its price is TAIL^2 log(1 + (z / TAIL)^2)."""

DAMPINGS = np.array([0.03, 0.3, 1.0, 10.0, 100.0])

SCALE = 5.0
"""Noise widths beyond which residuals count ever less."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations [px].

    Attributes:
      edge: of outlines.
      flow: of the objects' flow.
      background: of the flow beside them.
    """

    edge: Float[np.ndarray, "frames objects"]
    flow: Float[np.ndarray, "intervals objects"]
    background: float


LEAST_EDGE = 0.12
"""Noise of outlines that is assumed at least [px]."""

DRAWS = 12
"""Pairs of rollouts that measure chaos."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Where least squares ended.

    Attributes:
      hypothesis: what was fitted.
      z: the point.
      cost: half the sum of squares, with the prior.
      data: ditto without the prior.
      jacobian: of the residuals.
      residual: at the point, in noise widths times the root of their weight.
      evidence: logarithm of the hypothesis' probability, up to a constant of the clip (Laplace; MacKay 2003, ch. 28).
    """

    hypothesis: Hypothesis
    z: Float[np.ndarray, "dimension"]
    cost: float
    data: float
    jacobian: Float[np.ndarray, "residuals dimension"]
    residual: Float[np.ndarray, "residuals"]
    evidence: float

    @property
    def gradient(self) -> Float[np.ndarray, "dimension"]:
        """Of the cost."""
        price, slope = prior(self.hypothesis, self.z)
        return self.jacobian.T @ self.residual + slope * price

    @property
    def curvature(self) -> Float[np.ndarray, "dimension dimension"]:
        """Of the cost, by Gauss and Newton."""
        return self.jacobian.T @ self.jacobian + np.diag(prior(self.hypothesis, self.z)[1] ** 2)


def _everywhere(measured: Measured, frames: int) -> Noise:
    """The same noise in every frame."""
    return Noise(
        np.repeat(measured.edge_noise[None], frames, 0),
        np.repeat(measured.flow_noise[None], frames - 1, 0),
        measured.background_noise,
    )


def _independent(steps: np.ndarray) -> float:
    """As how many independent numbers the last axis counts: its length over the sum of its mean correlations."""
    count = steps.shape[-1]
    rows = steps.reshape(-1, count)
    rows = rows[(rows != 0).all(1)]
    if len(rows) < 10:
        return float(count) / 3
    # A few wild rows would speak for all.
    rows = rows / np.maximum(np.sqrt((rows**2).mean(1, keepdims=True)), 1e-12)
    return count / max(float((rows.sum(1) ** 2).mean()) / count, 1e-6)


def _middle(values: np.ndarray) -> float:
    """Median of what is finite; one where nothing is."""
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else 0.455


def prior(hypothesis: Hypothesis, z: Float[np.ndarray, "*batch dimension"]) -> tuple[np.ndarray, np.ndarray]:
    """The prior as residuals, and their derivatives in z: heavy-tailed for base parameters, normal for effects'."""
    heavy = hypothesis.ordinary
    residual = np.where(heavy, slowed(z, TAIL), z)
    square = (z / TAIL) ** 2
    slope = np.where(np.abs(z) > 1e-6, np.abs(z) / np.maximum((1 + square) * np.abs(residual), 1e-12), 1.0)
    return residual, np.where(heavy, np.maximum(slope, 0.1), 1.0)


class ClipFit:
    """Residuals and least squares for one clip.

    Args:
      simulator: of its scene kind and rate.
      measured: what was seen.
      image: (width, height) [px].
      frames: of the clip.
      noise: standard deviations; the measured ones by default.
    """

    def __init__(
        self, simulator: Simulator, measured: Measured, image: tuple[int, int], frames: int, noise: Noise | None = None
    ):
        self.simulator, self.measured, self.image, self.frames = simulator, measured, image, frames
        self.noise = noise or _everywhere(measured, frames)
        self.predictor = Predictor(simulator.shapes, measured.pixels, measured.places, image, simulator.fps)
        self.rollouts = 0.0
        self.edge_count, self.flow_count = EDGE_COUNT, FLOW_COUNT
        self._columns: np.ndarray | None = None
        self._slacks: dict[bytes | None, Slack] = {}

    def allow_slack(self, fit: Fit) -> int:
        """Lets the impacts of a base model's fit err from now on; returns how many there are."""
        batch = fit.hypothesis.batch(fit.z[None])
        poses = self.poses(fit.hypothesis, fit.z[None])[0]
        self._columns, self._slacks = None, {}
        if not np.isfinite(poses).all():
            return 0
        found = impacts(batch, poses, self.simulator.fps)
        if not found:
            return 0
        rows = kicked(self.simulator, batch, poses, found)
        self.rollouts += len(rows)
        many = batch.map(lambda a: np.repeat(a[:1], len(rows), 0))
        moved, still = self.predictor(rows, many), self.predictor(poses[None], batch)
        parts = [
            np.where(np.isfinite(measured)[None], np.nan_to_num(a - b), 0.0)
            for a, b, measured in (
                (moved.reach, still.reach, self.measured.reach),
                (moved.flow, still.flow, self.measured.flow),
                (moved.background, still.background, self.measured.background),
            )
        ]
        columns = self.whitened((parts[0], parts[1], parts[2]), None, 1e9)
        self._columns = columns[~moved.bad].T
        return len(found)

    def settle_noise(self, fit: Fit) -> None:
        """Sets the noise to what changes from frame to frame in the residuals of a fit, which no smooth misfit does."""
        m = self.measured
        a, b = m.reach.size, m.reach.size + m.flow.size
        reach, flow = fit.residual[:a].reshape(m.reach.shape), fit.residual[a:b].reshape(m.flow.shape)

        def rough(series: np.ndarray, measured: np.ndarray, share: float) -> np.ndarray:
            step = np.where(np.isfinite(measured), series, np.nan)
            square = np.diff(step, axis=0) ** 2 / 2 / share
            return np.array([np.sqrt(_middle(square[:, n]) / 0.455) for n in range(series.shape[1])])

        edge = np.clip(rough(reach, m.reach, self.edge_count / DIRECTIONS), 0.4, 1.5)
        moved = np.clip(rough(flow, m.flow, self.flow_count / m.flow.shape[-2]), 0.7, 3.0)
        self.edge_count = float(np.clip(_independent(np.diff(reach, axis=0)), *EDGE_COUNTS))
        told = float(np.clip(_independent(np.moveaxis(np.diff(flow, axis=0), -1, -2)), *FLOW_COUNTS))
        # Flow whose noise is not stated was measured, and errs smoothly in time as well.
        self.flow_count = told if m.stated else min(told, FLOW_COUNTS[0])
        edge, moved = m.edge_noise * edge, m.flow_noise * moved
        self.measured = dataclasses.replace(m, edge_noise=np.maximum(edge, LEAST_EDGE), flow_noise=moved)
        self.noise = _everywhere(self.measured, self.frames)

    def allow_chaos(self, fit: Fit, seed: int) -> None:
        """Adds the rollout's own jaggedness around a fit to the noise.

        After contacts the paths of bodies jump with the smallest change of a parameter. Of three rollouts on a line, two
        of them a posterior standard deviation to either side, the second difference is what no least squares can follow.
        """
        generator = np.random.default_rng(seed)
        factor = np.linalg.inv(np.linalg.cholesky(fit.curvature))
        steps = generator.standard_normal((DRAWS, len(fit.z))) @ factor
        low, high = fit.hypothesis.bounds
        z = np.clip(np.concatenate([fit.z + steps, fit.z - steps, fit.z[None]]), low, high)
        told = self.predictor(self.poses(fit.hypothesis, z), fit.hypothesis.batch(z))

        def bend(values: np.ndarray) -> np.ndarray:
            second = values[:DRAWS] + values[DRAWS:-1] - 2 * values[-1:]
            square = np.nan_to_num(np.where(told.bad[:DRAWS].reshape(-1, *(1,) * (second.ndim - 1)), 0.0, second)) ** 2
            return np.sqrt(np.median(square.reshape(*square.shape[:3], -1).mean(-1), axis=0) / 2.0)

        m = self.measured
        self.noise = Noise(
            np.hypot(m.edge_noise, bend(told.reach)), np.hypot(m.flow_noise, bend(told.flow)), self.noise.background
        )

    def _slack(self, keep: np.ndarray | None) -> Slack | None:
        if self._columns is None:
            return None
        key = None if keep is None else keep.tobytes()
        if key not in self._slacks:
            columns = self._columns if keep is None else self._columns * self._kept(keep)[:, None]
            self._slacks[key] = slack_of(columns)
        return self._slacks[key]

    def _kept(self, keep: np.ndarray) -> np.ndarray:
        """Which residuals belong to kept frames."""
        m = self.measured
        both = keep[:-1] & keep[1:]
        parts = [(keep, m.reach), (both, m.flow), (both, m.background)]
        return np.concatenate([np.repeat(held, array[0].size) for held, array in parts])

    # --- residuals ------------------------------------------------------------------------------------------------
    def distances(self, prediction: Prediction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Predicted minus measured [px]: reach, flow, background; NaN where nothing was measured."""
        m = self.measured
        # An object that nothing shows any more, where a mask is, misses it by its whole size.
        reach = np.where(np.isnan(prediction.reach) & np.isfinite(m.reach), 30.0, prediction.reach - m.reach)
        return reach, prediction.flow - m.flow, prediction.background - m.background

    def whitened(
        self,
        distances: tuple[np.ndarray, np.ndarray, np.ndarray],
        keep: Bool[np.ndarray, "frames"] | None,
        scale: float,
    ) -> Float[np.ndarray, "batch residuals"]:
        """Robust residuals in noise widths; zero where nothing was measured, and in frames that are not kept."""
        reach, flow, background = distances
        noise = self.noise
        parts = []
        for raw, sigma, count in (
            (reach, noise.edge[:, :, None], self.edge_count / reach.shape[-1]),
            (flow, noise.flow[:, :, None, None], self.flow_count / flow.shape[-2]),
            (background, noise.background, BACKGROUND_COUNT / max(background.shape[-2], 1)),
        ):
            part = slowed(np.nan_to_num(raw) / sigma, scale) * np.sqrt(count)
            parts.append(part.reshape(len(part), -1))
        white = np.concatenate(parts, 1)
        if keep is not None:
            white = white * self._kept(keep)
        slack = self._slack(keep)
        return white if slack is None else slack(white)

    def expected(self, beside: bool = True) -> float:
        """Sum of squares that noise alone would give, with the background's or without."""
        m = self.measured
        total = self.edge_count / m.reach.shape[-1] * float(np.isfinite(m.reach).sum())
        total += self.flow_count / m.flow.shape[-2] * float(np.isfinite(m.flow).sum())
        if beside:
            total += BACKGROUND_COUNT / max(m.background.shape[-2], 1) * float(np.isfinite(m.background).sum())
        return max(total, 1.0)

    def misfit(self, fit: Fit) -> float:
        """Mean square residual of the objects in noise widths."""
        objects = self.measured.reach.size + self.measured.flow.size
        return float((fit.residual[:objects] ** 2).sum()) / self.expected(beside=False)

    def rollout(self, batch: SceneBatch, frames: int) -> np.ndarray:
        """The simulator's, counted."""
        self.rollouts += len(batch) * frames / self.frames
        return self.simulator.rollout(batch, frames)

    def poses(self, hypothesis: Hypothesis, z: np.ndarray) -> np.ndarray:
        """Rollouts at the rows of ``z``."""
        self.rollouts += len(z)
        return self.simulator.rollout(hypothesis.batch(z), self.frames)

    def residuals(self, hypothesis: Hypothesis, z: np.ndarray, keep=None, scale: float = SCALE):
        """(residuals (B, R), half their sum of squares with the prior (B,))."""
        prediction = self.predictor(self.poses(hypothesis, z), hypothesis.batch(z))
        white = self.whitened(self.distances(prediction), keep, scale)
        cost = 0.5 * (white**2).sum(1) + 0.5 * (prior(hypothesis, z)[0] ** 2).sum(1)
        return white, np.where(prediction.bad, np.inf, cost)

    def jacobian(self, hypothesis: Hypothesis, z: np.ndarray, base: np.ndarray, keep=None, scale: float = SCALE):
        """d residuals / d z (R, D) by differences towards the inside of the bounds."""
        low, high = hypothesis.bounds
        size = np.where(hypothesis.ordinary, STEP, EFFECT_STEP)
        step = np.where(z + size > high, -size, size)
        points = np.clip(z + np.diag(step), low, high)
        moves = hypothesis.moves
        poses = np.repeat(self.poses(hypothesis, z[None]), len(z), 0)
        if moves.any():
            poses[moves] = self.poses(hypothesis, points[moves])
        prediction = self.predictor(poses, hypothesis.batch(points))
        white = self.whitened(self.distances(prediction), keep, scale)
        change = np.where(prediction.bad[:, None], 0.0, white - base)
        return (change / step[:, None]).T

    # --- least squares --------------------------------------------------------------------------------------------
    def fit(self, hypothesis: Hypothesis, z: np.ndarray, iterations: int = 12, keep=None, scale: float = SCALE) -> Fit:
        """Levenberg-Marquardt from ``z``."""
        low, high = hypothesis.bounds
        z = np.clip(z, low, high)
        base, costs = self.residuals(hypothesis, z[None], keep, scale)
        base, cost = base[0], float(costs[0])
        jacobian = self.jacobian(hypothesis, z, base, keep, scale)
        damping = 1.0
        for _ in range(iterations):
            price, slope = prior(hypothesis, z)
            gradient = jacobian.T @ base + slope * price
            curvature = jacobian.T @ jacobian + np.diag(slope**2)
            trials = np.array([self._step(z, gradient, curvature, f, low, high) for f in DAMPINGS * damping])
            moved, costs = self.residuals(hypothesis, trials, keep, scale)
            best = int(np.argmin(costs))
            if not costs[best] < cost:
                if damping > 1e3:
                    break
                damping *= 300.0
                continue
            gain = cost - float(costs[best])
            z, base, cost = trials[best], moved[best], float(costs[best])
            damping = float(np.clip(damping * DAMPINGS[best], 1e-3, 1e3))
            jacobian = self.jacobian(hypothesis, z, base, keep, scale)
            if gain < 0.05 + 2e-4 * cost:
                break
        return self._finished(hypothesis, z, base, jacobian)

    def best_of(self, hypothesis: Hypothesis, points: Float[np.ndarray, "points dimension"], keep=None) -> np.ndarray:
        """The point with the least cost."""
        low, high = hypothesis.bounds
        points = np.clip(points, low, high)
        return points[int(np.argmin(self.residuals(hypothesis, points, keep)[1]))]

    def hop(self, fit: Fit, seed: int, rounds: int = 3, count: int = 64, keep=None, scale: float = SCALE) -> Fit:
        """Least squares again from better points around its end.

        After contacts the residuals are jagged, and derivatives see only the nearest step. Draws from the fit's own
        posterior at several widths look beyond; each round least squares goes on from the best of them.
        """
        generator = np.random.default_rng(seed)
        low, high = fit.hypothesis.bounds
        for _ in range(rounds):
            factor = np.linalg.inv(np.linalg.cholesky(fit.curvature))
            width = np.geomspace(0.3, 8.0, count)[:, None]
            draws = generator.standard_normal((count, len(fit.z))) @ factor * width
            points = np.clip(fit.z + draws, low, high)
            _, costs = self.residuals(fit.hypothesis, points, keep, scale)
            best = np.argsort(costs)[:1]
            if not costs[best[0]] < fit.cost + 0.1 * abs(fit.cost):
                continue
            trial = self.fit(fit.hypothesis, points[best[0]], 6, keep, scale)
            if trial.cost < fit.cost:
                fit = trial
        return fit

    def _step(self, z, gradient, curvature, factor, low, high) -> np.ndarray:
        free = ~(((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0)))
        step = np.zeros(len(z))
        matrix = curvature[np.ix_(free, free)]
        matrix = matrix + factor * np.diag(np.maximum(0.01 * np.diag(matrix), 1.0))
        step[free] = -np.linalg.solve(matrix, gradient[free])
        step *= min(1.0, 12.0 / max(np.abs(step).max(initial=0.0), 1e-12))
        return np.clip(z + step, low, high)

    def _finished(self, hypothesis: Hypothesis, z, base, jacobian) -> Fit:
        data = 0.5 * float(base @ base)
        price_of_z, slope = prior(hypothesis, z)
        cost = data + 0.5 * float(price_of_z @ price_of_z)
        logdet = float(np.linalg.slogdet(jacobian.T @ jacobian + np.diag(slope**2))[1])
        price = sum(np.log(t.places) for t in hypothesis.terms)
        return Fit(hypothesis, z, cost, data, jacobian, base, -cost - 0.5 * logdet - price)

    def at(self, hypothesis: Hypothesis, z: np.ndarray, keep=None, scale: float = SCALE) -> Fit:
        """No step, just what holds at ``z``."""
        base, _ = self.residuals(hypothesis, z[None], keep, scale)
        return self._finished(hypothesis, z, base[0], self.jacobian(hypothesis, z, base[0], keep, scale))
