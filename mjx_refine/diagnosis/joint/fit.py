"""Least squares of one set-up on several clips: robust, with a standard normal prior, and its evidence."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.batch import concatenate
from mjx_refine.diagnosis.fits.fit import SCALE, ClipFit, Fit, prior
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.pace import DAMPINGS, Pace, behind
from mjx_refine.diagnosis.fits.store import Arrays, fingerprint, packed, remembered, unpacked
from mjx_refine.diagnosis.joint.arrow import Arrow
from mjx_refine.diagnosis.joint.differences import JointDifferences, Sizes
from mjx_refine.diagnosis.joint.hypothesis import JointHypothesis, with_frozen_setup
from mjx_refine.effects.loading import has_loads

Keeps = Sequence[Bool[np.ndarray, "frames"]] | None

TOGETHER = 512
"""Candidates of several clips that are simulated in one batch: effects that need a look at every step share its overhead."""

DRAWS = (16, 8)
"""Draws of what is shared around a fit, and of each clip's own start for each of them."""


@dataclasses.dataclass(frozen=True)
class JointFit:
    """Where least squares ended.

    Attributes:
      hypothesis: what was fitted.
      z: the point.
      cost: half the sum of squares, with the prior.
      data: ditto without the prior.
      parts: each clip's side of it; their ``cost`` is their ``data``, and their ``evidence`` says nothing.
      evidence: logarithm of the hypothesis' probability, up to a constant of the clips.
    """

    hypothesis: JointHypothesis
    z: Float[np.ndarray, "dimension"]
    cost: float
    data: float
    parts: tuple[Fit, ...]
    evidence: float

    @property
    def gradient(self) -> Float[np.ndarray, "dimension"]:
        """Of the cost."""
        price, slope = prior(self.hypothesis, self.z)  # type: ignore[arg-type]
        return _gathered(self.hypothesis, [p.jacobian.T @ p.residual for p in self.parts]) + slope * price

    @property
    def curvature(self) -> Arrow:
        """Of the cost, by Gauss and Newton."""
        slope = prior(self.hypothesis, self.z)[1]  # type: ignore[arg-type]
        return Arrow.of([p.jacobian.T @ p.jacobian for p in self.parts], self.hypothesis.masks, slope**2)


def _gathered(hypothesis: JointHypothesis, parts: list[np.ndarray]) -> np.ndarray:
    """The sum of parts' vectors (or columns of them) in joint coordinates."""
    result = np.zeros((hypothesis.dimension, *parts[0].shape[1:]))
    for part, index in zip(parts, hypothesis.index, strict=True):
        result[index] += part
    return result


class Clips:
    """Residuals and least squares of several clips.

    Args:
      clips: each with its measurements; those of one scene kind and rate should have one simulator.
    """

    def __init__(self, clips: Sequence[ClipFit]):
        self.clips = tuple(clips)
        self.store = self.clips[0].store

    def __len__(self) -> int:
        return len(self.clips)

    @property
    def rollouts(self) -> float:
        return sum(clip.rollouts for clip in self.clips)

    @property
    def frames(self) -> int:
        """Of the longest clip."""
        return max(clip.frames for clip in self.clips)

    def expected(self) -> float:
        """Sum of squares that noise alone would give."""
        return sum(clip.expected() for clip in self.clips)

    def misfit(self, fit: JointFit) -> float:
        """Mean square residual of the objects in noise widths."""
        weights = np.array([clip.expected(without=("background",)) for clip in self.clips])
        each = np.array([clip.misfit(part) for clip, part in zip(self.clips, fit.parts, strict=True)])
        return float((weights * each).sum() / weights.sum())

    # --- what is kept of fits ---------------------------------------------------------------------------------------
    def state(self) -> str:
        """As ``ClipFit.state``, of all clips."""
        return fingerprint([clip.state() for clip in self.clips])

    def pack(self, fit: JointFit) -> Arrays:
        """What a store keeps of a fit."""
        whole = {"whole": np.array([fit.cost, fit.data, fit.evidence]), "joint": fit.z}
        return {**whole, **{k: v for c, part in enumerate(fit.parts) for k, v in packed(part, f"_{c}").items()}}

    def unpack(self, hypothesis: JointHypothesis, arrays: Arrays) -> JointFit:
        """The fit again."""
        cost, data, evidence = arrays["whole"].tolist()
        parts = tuple(unpacked(part, arrays, f"_{c}") for c, part in enumerate(hypothesis.parts))
        return JointFit(hypothesis, arrays["joint"], cost, data, parts, evidence)

    def counted(self) -> np.ndarray:
        """Rollouts of each clip so far."""
        return np.array([clip.rollouts for clip in self.clips])

    def count(self, more: np.ndarray) -> None:
        """Counts rollouts that an interrupted run made."""
        for clip, one in zip(self.clips, more.tolist(), strict=True):
            clip.rollouts += one

    # --- rollouts -------------------------------------------------------------------------------------------------
    def poses(self, hypothesis: JointHypothesis, points: list[np.ndarray]) -> list[np.ndarray]:
        """Rollouts at each part's points, (batch, frames, objects, 7) a clip."""
        batches = [part.batch(z) for part, z in zip(hypothesis.parts, points, strict=True)]
        lengths = {tuple(e.values.shape[1] for e in batch.effects) for batch in batches}
        simulators = {id(clip.simulator) for clip in self.clips}
        if not (has_loads(batches[0]) and len(lengths) == 1 and len(simulators) == 1):
            return [clip.simulator.rollout(b, clip.frames) for clip, b in self._counted(batches)]
        whole = concatenate([batch for _, batch in self._counted(batches)])
        rows = [
            self.clips[0].simulator.rollout(whole[slice(k, k + TOGETHER)], self.frames)
            for k in range(0, len(whole), TOGETHER)
        ]
        parts = np.split(np.concatenate(rows), np.cumsum([len(b) for b in batches])[:-1])
        return [part[:, : clip.frames] for clip, part in zip(self.clips, parts, strict=True)]

    def _counted(self, batches):
        for clip, batch in zip(self.clips, batches, strict=True):
            clip.rollouts += len(batch)
            yield clip, batch

    # --- residuals ------------------------------------------------------------------------------------------------
    def residuals(self, hypothesis: JointHypothesis, z: np.ndarray, keeps: Keeps = None, scale: float = SCALE):
        """(residuals (B, R) a clip, half their sum of squares with the prior (B,))."""
        points = hypothesis.split(z)
        cost = 0.5 * (prior(hypothesis, z)[0] ** 2).sum(1)  # type: ignore[arg-type]
        rows = []
        for c, poses in enumerate(self.poses(hypothesis, points)):
            white, bad = self._white(c, hypothesis.parts[c], points[c], poses, keeps, scale)
            cost = np.where(bad, np.inf, cost + 0.5 * (white**2).sum(1))
            rows.append(white)
        return rows, cost

    def _white(self, c: int, part: Hypothesis, z: np.ndarray, poses: np.ndarray, keeps: Keeps, scale: float):
        clip = self.clips[c]
        prediction = clip.predictor(poses, part.batch(z))
        white = clip.whitened(clip.distances(prediction), None if keeps is None else keeps[c], scale)
        return white, prediction.bad

    def jacobians(self, hypothesis: JointHypothesis, z, base, sizes: Sizes, keeps: Keeps = None, scale=SCALE):
        """d residuals / d z of each clip in its own coordinates, (R, part), by differences of its sizes; None for no sizes."""
        points, steps, moved = [], [], []
        for part, at, size in zip(hypothesis.parts, hypothesis.split(z), sizes, strict=True):
            step = (
                np.zeros((0, len(at))) if size is None else np.diag(np.where(at + size > part.bounds[1], -size, size))
            )
            points.append(np.clip(at + step, *part.bounds))
            steps.append(np.diag(step))
            moved.append(np.concatenate([at[None], points[-1][part.moves[: len(step)]]]))
        result: list[Any] = []
        for c, poses in enumerate(self.poses(hypothesis, moved)):
            if sizes[c] is None:
                result.append(None)
                continue
            whole = np.repeat(poses[:1], len(points[c]), 0)
            whole[hypothesis.parts[c].moves] = poses[1:]
            white, bad = self._white(c, hypothesis.parts[c], points[c], whole, keeps, scale)
            result.append((np.where(bad[:, None], 0.0, white - base[c]) / steps[c][:, None]).T)
        return result

    def _differences(self, hypothesis: JointHypothesis, keeps: Keeps, scale: float) -> JointDifferences:
        return JointDifferences(
            hypothesis,
            lambda points: self.residuals(hypothesis, points, keeps, scale),
            lambda z, base, sizes: self.jacobians(hypothesis, z, base, sizes, keeps, scale),
        )

    # --- least squares --------------------------------------------------------------------------------------------
    @remembered
    def fit(
        self,
        hypothesis: JointHypothesis,
        z: np.ndarray,
        iterations: int = 12,
        keeps: Keeps = None,
        scale=SCALE,
        rival: float = np.inf,
    ) -> JointFit:
        """Levenberg-Marquardt from ``z``, as ``ClipFit.fit``."""
        low, high = hypothesis.bounds
        z = np.clip(z, low, high)
        rows, costs = self.residuals(hypothesis, z[None], keeps, scale)
        base, cost = [row[0] for row in rows], float(costs[0])
        told = self._differences(hypothesis, keeps, scale)
        fit, surest = self._finished(hypothesis, z, base, told.surest(z, base)), True
        pace = Pace(told.tried())
        for attempt in range(1, iterations + 1):
            gradient, curvature = fit.gradient, fit.curvature
            trials = np.array([_step(z, gradient, curvature, f, low, high) for f in DAMPINGS * pace.damping])
            rows, costs = self.residuals(hypothesis, trials, keeps, scale)
            best = int(np.argmin(costs))
            gain = cost - float(costs[best])
            if gain > 0:
                z, base, cost = trials[best], [row[best] for row in rows], float(costs[best])
            if pace.done(gain, best, cost) or behind(attempt, cost, rival):
                break
            fit, surest = self._finished(hypothesis, z, base, told.of(z, base, pace.size)), False
        return fit if surest and fit.z is z else self._finished(hypothesis, z, base, told.surest(z, base))

    def at(self, hypothesis: JointHypothesis, z: np.ndarray, keeps: Keeps = None, scale: float = SCALE) -> JointFit:
        """No step, just what holds at ``z``."""
        base = [row[0] for row in self.residuals(hypothesis, z[None], keeps, scale)[0]]
        return self._finished(hypothesis, z, base, self._differences(hypothesis, keeps, scale).surest(z, base))

    def best_of(self, hypothesis: JointHypothesis, points: np.ndarray) -> np.ndarray:
        """The point with the least cost."""
        points = np.clip(points, *hypothesis.bounds)
        return points[int(np.argmin(self.residuals(hypothesis, points)[1]))]

    def _finished(self, hypothesis: JointHypothesis, z, base, jacobians) -> JointFit:
        halves = [0.5 * float(row @ row) for row in base]
        price, _ = prior(hypothesis, z)  # type: ignore[arg-type]
        cost = sum(halves) + 0.5 * float(price @ price)
        told = zip(hypothesis.parts, hypothesis.split(z), halves, jacobians, base, strict=True)
        parts = tuple(Fit(part, at, half, half, jacobian, row, -half) for part, at, half, jacobian, row in told)
        fit = JointFit(hypothesis, z, cost, sum(halves), parts, 0.0)
        places = sum(np.log(t.places) for t in hypothesis.terms)
        return dataclasses.replace(fit, evidence=-cost - 0.5 * fit.curvature.logdet - float(places))

    # --- one clip at a time -----------------------------------------------------------------------------------------
    def own(self, fit: JointFit, c: int, z: np.ndarray | None = None) -> tuple[Hypothesis, np.ndarray]:
        """The hypothesis of clip ``c`` in which only its start is free, and where that stands."""
        part, at = fit.hypothesis.parts[c], fit.hypothesis.split(fit.z if z is None else z)[c]
        return with_frozen_setup(part, at), at[~fit.hypothesis.masks[c]]

    @remembered
    def hop(self, fit: JointFit, seed: int, rounds: int = 3) -> JointFit:
        """Least squares again from better points around its end, as ``ClipFit.hop``.

        Given what is shared, clips owe one another nothing: of every draw of the set-up each clip takes the best of its own
        draws of the start, so that few draws do for many clips.
        """
        generator = np.random.default_rng(seed)
        for _ in range(rounds):
            points, costs = self._draws(fit, generator)
            changed = False
            for k in np.argsort(costs)[:2]:
                if costs[k] < fit.cost + 0.2 * abs(fit.cost):
                    trial = self.fit(fit.hypothesis, points[k], 5)
                    if trial.cost < fit.cost:
                        fit, changed = trial, True
            if not changed and np.min(costs) > fit.cost + 0.2 * abs(fit.cost):
                break
        return fit

    def _draws(self, fit: JointFit, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Points around a fit, each with every clip's best start, and their costs."""
        hypothesis, curvature = fit.hypothesis, fit.curvature
        low, high = hypothesis.bounds
        # Where more than noise is left, so much more may the parameters be off.
        off = np.sqrt(max(1.0, self.misfit(fit)))
        wide = off * np.concatenate([[0.0], np.geomspace(0.3, 8.0, DRAWS[0] - 1)])[:, None]
        shared = generator.standard_normal((DRAWS[0], hypothesis.count)) @ _root_of_inverse(curvature.schur) * wide
        narrow = off * np.concatenate([[0.0], np.geomspace(0.3, 6.0, DRAWS[1] - 1)])[:, None]
        rows, priors = [], []
        for c, (index, mask) in enumerate(zip(hypothesis.index, hypothesis.masks, strict=True)):
            block = curvature.own[c]
            follows = -np.linalg.solve(block, curvature.cross[c].T @ shared.T).T
            own = generator.standard_normal((DRAWS[0], DRAWS[1], len(block))) @ _root_of_inverse(block) * narrow
            z = np.empty((*own.shape[:2], len(mask)))
            z[..., mask] = shared[:, None]
            z[..., ~mask] = follows[:, None] + own
            z = np.clip(z + fit.z[index], low[index], high[index])
            rows.append(z.reshape(-1, len(mask)))
            priors.append(0.5 * (prior(hypothesis.parts[c], rows[-1])[0][:, ~mask] ** 2).sum(1))
        costs = np.zeros(DRAWS[0])
        points = np.repeat(fit.z[None], DRAWS[0], 0)
        for c, poses in enumerate(self.poses(hypothesis, rows)):
            white, bad = self._white(c, hypothesis.parts[c], rows[c], poses, None, SCALE)
            each = np.where(bad, np.inf, 0.5 * (white**2).sum(1) + priors[c]).reshape(DRAWS)
            best = each.argmin(1)
            costs += each.min(1)
            points[:, hypothesis.index[c]] = rows[c].reshape(*DRAWS, -1)[np.arange(DRAWS[0]), best]
        price = prior(hypothesis, points)[0][:, : hypothesis.count]  # type: ignore[arg-type]
        return points, costs + 0.5 * (price**2).sum(1)

    def restarted(self, fit: JointFit, seed: int, good: float) -> JointFit:
        """Clips that a fit leaves far off search for another start by themselves; then all are fitted again."""
        z = fit.z.copy()
        changed = False
        for c, clip in enumerate(self.clips):
            if clip.misfit(fit.parts[c]) < good:
                continue
            hypothesis, at = self.own(fit, c)
            here = clip.hop(clip.fit(hypothesis, at, 4), seed + c, 1)
            if here.data < fit.parts[c].data - 1.0:
                z[fit.hypothesis.index[c][~fit.hypothesis.masks[c]]] = here.z
                changed = True
        if changed:
            again = self.fit(fit.hypothesis, z, 8)
            fit = again if again.cost < fit.cost else fit
        return self.hop(fit, seed) if self.misfit(fit) > good else fit


def _root_of_inverse(matrix: np.ndarray) -> np.ndarray:
    """R with R' R the inverse: rows of standard normals times R have the inverse for covariance."""
    return np.linalg.inv(np.linalg.cholesky(matrix))


def _step(z, gradient, curvature: Arrow, factor: float, low, high) -> np.ndarray:
    free = ~(((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0)))
    matrix = curvature.plus(factor * np.maximum(0.01 * curvature.diagonal, 1.0)).only(free)
    step = np.where(free, -matrix.solve(np.where(free, gradient, 0.0)), 0.0)
    step *= min(1.0, 12.0 / max(np.abs(step).max(initial=0.0), 1e-12))
    return np.clip(z + step, low, high)
