"""Landing: least squares on outlines takes a rough scene to where a population search can finish.

Levenberg-Marquardt (Marquardt 1963) on the maximum a posteriori problem: residuals are how far each silhouette reaches
in 16 directions, beside what the masks show [px], and the distance from the start in prior widths. Derivatives are
finite differences over rollouts, a whole Jacobian and a whole line search being one batch each, or automatic ones
through MJX. The horizon grows from the first frame to the last: an early collision must be right before what follows it
means anything.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mjx_refine.search.course import Course, Landing
from mjx_refine.search.features import DIRECTIONS, POINTS
from mjx_refine.search.residuals import Residuals
from mjx_refine.search.schedule import Stage

DAMPINGS = np.array([1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0])
"""Multiples of the prior's curvature that one line search tries."""

SCATTER = 256
"""Points that one attempt draws."""

MISFIT = 1.5
"""Root mean square distance of outlines [px at a picture 480 wide] above which an object is said not to fit."""

FITS = 1.5
"""The same of one frame, above which its horizon is fitted by a stage of its own."""

EARLY = 0.35
"""Part of the clip whose horizons are never left out: outlines that fit there do not yet tell velocities and spins."""

TURNS = ("yaw", "tilt", "lean")
"""Fields of the parameter space that turn an object at the start."""

Progress = Callable[[Stage, np.ndarray, float], bool | None]
"""Is told a stage, where it ended and its cost."""


class LeastSquares(Residuals):
    """Levenberg-Marquardt on the residuals of points in the unit box."""

    @property
    def _spent(self) -> bool:
        """Whether another Jacobian and line search would exceed the limit."""
        return self.evaluations + self.space.dimension + 2 * len(DAMPINGS) > self.limit

    def run(
        self,
        start: np.ndarray,
        schedule: list[Stage],
        hops: int = 0,
        progress: Progress | None = None,
    ) -> Landing:
        """Goes through the stages from ``start``.

        Args:
          start: in the unit box.
          schedule: horizons, in order.
          hops: attempts at each horizon to find a better basin for objects that do not fit.
          progress: called after each stage; False from it ends the landing there.
        """
        return self.land(Course(start), schedule, hops, progress)

    def follow(self, course: Course, schedule: list[Stage], until: int) -> Course:
        """The stages of at most ``until`` frames."""
        stop = course.stage + sum(stage.frames <= until for stage in schedule[course.stage :])
        return self._follow(course, schedule, stop)[0]

    def land(
        self,
        course: Course,
        schedule: list[Stage],
        hops: int = 0,
        progress: Progress | None = None,
    ) -> Landing:
        """The stages that are left, see ``run``."""
        before = self.evaluations
        course, jacobian = self._follow(course, schedule, len(schedule), hops, progress)
        point, last = course.point, schedule[-1]
        if course.cost < np.inf and not len(jacobian) and self.evaluations + len(point) < self.limit:
            base, _ = self.residuals(point[None], last.frames, last.scale)
            jacobian = self.jacobian(point, base[0], last.frames, last.scale)
        curvature = jacobian.T @ jacobian + np.eye(len(point))
        scale = self.space.sigma
        return Landing(
            point=point,
            cost=course.cost,
            covariance=np.linalg.inv(curvature) * np.outer(scale, scale),
            sensitivity=np.linalg.norm(jacobian, axis=0),
            evaluations=self.evaluations - before,
        )

    def _follow(
        self, course: Course, schedule: list[Stage], stop: int, hops: int = 0, progress: Progress | None = None
    ) -> tuple[Course, np.ndarray]:
        """Stages up to ``stop``, and the Jacobian where the last of them ended, without rows where none was computed."""
        generator = np.random.default_rng(self.seed)
        point, cost, known = course.point, course.cost, course.known
        jacobian = np.zeros((0, len(point)))
        for k in range(course.stage, stop):
            stage = schedule[k]
            if self._spent:
                break
            if EARLY * len(self.target) < stage.frames <= known and stage.frames < len(self.target):
                continue
            slopes = hops > 0 or k == len(schedule) - 1
            if stage.frames > 1 and len(jacobian):
                point, cost, jacobian = self._extend(point, jacobian, stage, hops, generator)
            else:
                point, cost, jacobian = self._stage(point, stage, slopes)
            if progress and progress(stage, point, cost) is False:
                break
            if len(schedule) > 1:
                known = self._fitting(point, stage.frames)
        return Course(point, cost, known, stop), jacobian

    def _extend(self, point, jacobian, stage: Stage, hops: int, generator):
        """Least squares at a longer horizon, from several points that the shorter one leaves open.

        A single picture does not tell how far away, hence how large, an object in the air is, nor what the next contact
        will do; derivatives end there. Objects that have not met move independently, and a rollout of all tells the cost
        of each: the best draw of every object that does not fit is combined into one point.
        """
        best = self._stage(point, stage, True)
        for _ in range(hops):
            misfit = self._misfit(best[0], stage)
            if not misfit.any() or self._spent:
                break
            combined = self._combined(point, best[0], jacobian, misfit, stage, generator)
            hop = self._stage(combined, stage, True)
            if hop[1] < best[1]:
                best = hop
        return best

    def _fitting(self, point: np.ndarray, frames: int) -> int:
        """Frames from the first on whose outlines fit, at least ``frames``: horizons among them need no stage.

        Not of solvers that are not ours: they take one step length at a time, and need the shorter horizons.
        """
        length = len(self.target)
        if frames >= length or self.solver != "lm":
            return frames
        raw = self.distances(point[None], length)[0][0]
        seen = np.isfinite(raw).sum(2)
        rms = np.sqrt(np.nansum(raw**2, 2) / np.maximum(seen, 1)).max(1)
        wrong = np.nonzero(rms > FITS)[0]
        return max(frames, int(wrong[0]) if len(wrong) else length)

    def _misfit(self, point: np.ndarray, stage: Stage) -> np.ndarray:
        raw = self.distances(point[None], stage.frames)[0][0]
        seen = np.isfinite(raw).sum((0, 2))
        return np.sqrt(np.nansum(raw**2, (0, 2)) / np.maximum(seen, 1)) > MISFIT

    def _combined(self, before, now, jacobian, misfit: np.ndarray, stage: Stage, generator) -> np.ndarray:
        """``now``, with the misfitting objects' parameters from the best of many draws around ``before``."""
        owner = np.array([p.index[0] for p in self.space.parameters])
        points = self._draws(before, jacobian, generator)
        keep = ~np.isin(owner, np.nonzero(misfit)[0])
        points[:, keep] = now[keep]
        reach, flow, bad = self.distances(points, stage.frames)
        prices = 0.5 * (self._robust(reach, flow, stage.scale) ** 2).sum((1, 3)) + np.where(bad, 1e12, 0.0)[:, None]
        combined = now.copy()
        for n in np.nonzero(misfit)[0]:
            combined[owner == n] = points[int(np.argmin(prices[:, n]))][owner == n]
        return combined

    def _draws(self, point, jacobian, generator) -> np.ndarray:
        """Points around ``point``: half from what its horizon leaves open (the posterior of least squares), half from
        the prior, with any orientation where an object is in the air."""
        count, size = SCATTER // 2, len(point)
        factor = np.linalg.inv(np.linalg.cholesky(jacobian.T @ jacobian + np.eye(size)))
        near = (generator.standard_normal((count, size)) @ factor) * np.geomspace(0.3, 3.0, count)[:, None]
        far = generator.standard_normal((count, size)) * np.geomspace(0.1, 1.0, count)[:, None]
        for j, parameter in enumerate(self.space.parameters):
            if parameter.field in TURNS and parameter.width > 0.1:
                far[:, j] = generator.uniform(-1.0, 1.0, count) * min(1.6, parameter.high) / parameter.width
        return np.clip(point + np.concatenate([near, far]) * self.space.sigma, 0.0, 1.0)

    def _stage(self, point: np.ndarray, stage: Stage, slopes: bool) -> tuple[np.ndarray, float, np.ndarray]:
        """One stage from ``point``: (point, cost, Jacobian; without rows where nothing was left for one, or where it was
        not asked for by ``slopes``)."""
        if self.solver != "lm":
            return self._others_stage(point, stage)
        sigma, start = self.space.sigma, self.space.start
        damping = 1.0
        self._foresee_slopes(point[None], stage.frames)
        base, costs = self.residuals(point[None], stage.frames, stage.scale)
        base, cost = base[0], float(costs[0])
        if self._spent:
            return point, cost, np.zeros((0, len(point)))
        jacobian = None
        for _ in range(stage.iterations):
            if self._spent:
                break
            if jacobian is None:
                jacobian = self.jacobian(point, base, stage.frames, stage.scale)
            gradient = jacobian.T @ base + (point - start) / sigma
            curvature = jacobian.T @ jacobian + np.eye(len(point))
            steps = [self._bounded_step(point, gradient, curvature, factor) for factor in DAMPINGS * damping]
            trials = np.clip(point + np.array(steps) * sigma, 0.0, 1.0)
            self._foresee_slopes(trials, stage.frames)
            moved, costs = self.residuals(trials, stage.frames, stage.scale)
            best = int(np.argmin(costs))
            if not costs[best] < cost:
                if damping > 1e4:
                    break
                damping *= 1e3
                continue
            gain = cost - float(costs[best])
            point, base, cost = trials[best], moved[best], float(costs[best])
            damping = float(np.clip(damping * DAMPINGS[best] / DAMPINGS[2], 1e-3, 1e3))
            jacobian = None
            if gain < 1e-3 * cost:
                break
        if jacobian is None and slopes and not self._spent:
            jacobian = self.jacobian(point, base, stage.frames, stage.scale)
        return point, cost, np.zeros((0, len(point))) if jacobian is None else jacobian

    def _foresee_slopes(self, points: np.ndarray, frames: int) -> None:
        """Simulates ``points`` and what differences at each of them look at."""
        if self.automatic is None:
            self.foresee(points, (self.beside(point)[0] for point in points), frames)

    def _others_stage(self, point: np.ndarray, stage: Stage) -> tuple[np.ndarray, float, np.ndarray]:
        """One stage by a solver that is not ours."""
        # jaxopt and optax take a second to import.
        from mjx_refine.search.solvers import StageProblem, improve

        def residuals(at: np.ndarray) -> tuple[np.ndarray, float]:
            base, costs = self.residuals(at[None], stage.frames, stage.scale)
            return base[0], float(costs[0])

        def jacobian(at: np.ndarray, base: np.ndarray) -> np.ndarray:
            return self.jacobian(at, base, stage.frames, stage.scale)

        flow = 0 if self.flow is None else 2 * POINTS
        size = self.target.shape[0] * self.target.shape[1] * (DIRECTIONS + flow)
        problem = StageProblem(residuals, jacobian, self.space.start, self.space.sigma, size)
        return improve(self.solver, problem, point, stage.iterations, lambda: self._spent)

    def _bounded_step(self, point, gradient, curvature, factor) -> np.ndarray:
        """The damped step [prior widths] with coordinates at a bound that push outwards held there."""
        free = ~(((point <= 0.0) & (gradient > 0)) | ((point >= 1.0) & (gradient < 0)))
        step = np.zeros(len(point))
        matrix = curvature[np.ix_(free, free)]
        matrix = matrix + factor * np.diag(np.maximum(np.diag(matrix) * 0.01, 1.0))
        step[free] = -np.linalg.solve(matrix, gradient[free])
        length = np.abs(step).max(initial=0.0)
        return step * min(1.0, 3.0 / max(length, 1e-12))
