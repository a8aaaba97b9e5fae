"""Least squares of a hypothesis on one clip's measurements: robust, with a standard normal prior, and its evidence."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.diagnosis.fits.apart import Flight, beside
from mjx_refine.diagnosis.fits.chaos import EXCUSED, believed, drawn, jaggedness
from mjx_refine.diagnosis.fits.crew import Crew
from mjx_refine.diagnosis.fits.fitted import Fit, prior
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.nodes import missed_by, missing, with_struck
from mjx_refine.diagnosis.fits.pace import STEPS, Differences, Effort, Standing, descended
from mjx_refine.diagnosis.fits.roam import ROAMED, Strategy, hopped, looked_around
from mjx_refine.diagnosis.fits.settled import Loose, Settled
from mjx_refine.diagnosis.fits.slack import PART, Contacts, Impact, Slack, Slacks, contacts, kicked
from mjx_refine.diagnosis.fits.store import Arrays, Store, fingerprint, packed, remembered, unpacked
from mjx_refine.diagnosis.seen.drawn_along import always_off
from mjx_refine.diagnosis.seen.measure import Measured, Parts
from mjx_refine.diagnosis.seen.noise import Counts, Noise, blurred, everywhere, jagged, settled
from mjx_refine.diagnosis.seen.predict import Prediction, Predictor
from mjx_refine.scene import Shape
from mjx_refine.search.residuals import slowed
from mjx_refine.sim.backends import Restarting
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.recalled import Recalling

SCALE = 5.0
"""Noise widths beyond which residuals count ever less."""

PATIENCE = Parts(1.0, 1.0, 6.0, 1.0)
"""The same for each kind of measurement, in multiples: a centroid is either of the whole mask or not measured at all."""


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
        self, simulator: Restarting, measured: Measured, image: tuple[int, int], frames: int, noise: Noise | None = None
    ):
        self.simulator, self.measured, self.image, self.frames = simulator, measured, image, frames
        self.noise = noise or everywhere(measured, frames)
        self.predictor = Predictor.of(measured, simulator.shapes, image, simulator.fps)
        self.rollouts, self.counts, self.slackness = 0.0, Counts(), 1.0
        self.store, self.crew, self._slacks = Store(), Crew(), Slacks()
        self._loose: Loose | None = None
        self._columns: np.ndarray | None = None

    # --- in other processes -----------------------------------------------------------------------------------------
    def again(self) -> Callable[[int], ClipFit]:
        """Makes the clip anew, in whatever process, with so many threads."""
        simulator = self.simulator
        return functools.partial(_made, simulator.shapes, simulator.fps, self.measured, self.image, self.frames)

    @property
    def settled(self) -> Settled:
        """All that residuals depend on beside the clip itself and the hypothesis."""
        return Settled(self.measured, self.noise, self.counts, self._columns)

    @settled.setter
    def settled(self, told: Settled) -> None:
        self.measured, self.noise, self.counts, self._columns = told.measured, told.noise, told.counts, told.columns
        self._loose, self._slacks = None, Slacks()

    def warm(self) -> None:
        """Compiles what predictions need."""
        self.predictor.warm(self.frames)

    # --- what is kept of fits ---------------------------------------------------------------------------------------
    def state(self) -> str:
        """A fingerprint of all but the hypothesis that residuals depend on."""
        noise = (self.noise.edge, self.noise.flow, self.noise.moments, self.noise.background)
        loose = self._columns if self._columns is not None else "rigid"
        return fingerprint(self.facts, noise, (self.counts.edge, self.counts.flow), loose)

    @functools.cached_property
    def facts(self) -> str:
        """A fingerprint of the clip."""
        return fingerprint(
            tuple(self.measured.parts), self.measured.pixels, self.image, self.frames, self.simulator.fps
        )

    def pack(self, fit: Fit) -> Arrays:
        """What a store keeps of a fit."""
        return packed(fit, "")

    def unpack(self, hypothesis: Hypothesis, arrays: Arrays) -> Fit:
        """The fit again."""
        return unpacked(hypothesis, arrays, "")

    def counted(self) -> np.ndarray:
        """Rollouts so far."""
        return np.array([self.rollouts])

    def count(self, more: np.ndarray) -> None:
        """Counts rollouts that an interrupted run made."""
        self.rollouts += float(more[0])

    def allow_slack(self, fit: Fit) -> int:
        """Lets contacts along a fit's path err, and masks be a little wide; returns how many impacts there are."""
        self._loose, self._columns, self._slacks = None, None, Slacks()
        self._loose, found = self._loose_along(fit) or (None, 0)
        self.set_slackness(self.slackness)
        return found

    def contacts_along(self, fit: Fit) -> tuple[SceneBatch, Float[np.ndarray, "frames objects 7"], Contacts] | None:
        """A fit's candidate, its path, and the contacts on it; None where no path is."""
        batch, poses = fit.hypothesis.batch(fit.z[None]), self.poses(fit.hypothesis, fit.z[None])[0]
        if not np.isfinite(poses).all():
            return None
        plain = self.poses(*fit.ordinary)[0] if fit.hypothesis.terms else None
        return batch, poses, self._contacts(batch, poses, plain)

    def slack_along(self, fit: Fit) -> Float[np.ndarray, "residuals columns"] | None:
        """What contacts along a fit's own path may err by, as a hypothesis holds it; None where none may, or no path is."""
        along = None if self._columns is None else self._loose_along(fit)
        return None if along is None else along[0].columns(self.slackness, self.rigid)

    def _loose_along(self, fit: Fit) -> tuple[Loose, int] | None:
        if (along := self.contacts_along(fit)) is None:
            return None
        batch, poses, (found, long) = along
        found, still = with_struck(found, fit.hypothesis.nodes), self.predictor(poses[None], batch)
        kicks = self.kicks(batch, poses, still, [*found, *long], PART) if found or long else None
        return self._loosened(batch, poses, found, still, kicks), len(found)

    def _contacts(self, batch: SceneBatch, poses: np.ndarray, plain: np.ndarray | None) -> Contacts:
        return contacts(batch, poses, plain, self.simulator.fps)

    def _loosened(self, batch: SceneBatch, poses: np.ndarray, found: list[Impact], still: Prediction, kicks) -> Loose:
        sharp, marks = self.noise, [(i.target, i.frame) for i in found]
        always = always_off(self.measured, still.flow, still.whole)
        return Loose(always, kicks, lambda part: blurred(sharp, still.whole[0], marks, part))

    def kicks(self, batch: SceneBatch, poses: np.ndarray, still: Prediction, found: list[Impact], part: float) -> Parts:
        """What impacts that err by ``part`` of themselves change in what ``still`` predicts, one standard deviation a row."""
        rows = kicked(self.simulator, batch, poses, found, part)
        self.rollouts += len(rows)
        for one in batch.restarts:
            # From there on the object goes on as it does, whatever it was kicked by before.
            before = np.repeat([i.target == one.target and i.frame < one.frame for i in found], 6)
            rows[before, one.frame :, one.target] = poses[one.frame :, one.target]
        moved = self.predictor(rows, batch.map(lambda a: np.repeat(a[:1], len(rows), 0)))
        return Parts(*(change[~moved.bad] for change in self._change(moved, still)))

    def set_slackness(self, slackness: float) -> None:
        """How much contacts may err, as a multiple of what they may in one clip alone."""
        self.slackness, self._slacks = slackness, Slacks()
        if self._loose is not None:
            self.noise = self._loose.blurred(slackness)
            self._columns = self._loose.columns(slackness, self.rigid)

    def forget_slack(self, noise: Noise) -> None:
        """Contacts may not err any more."""
        self.noise, self._loose, self._columns, self._slacks = noise, None, None, Slacks()

    def _change(self, moved: Prediction, still: Prediction) -> Parts:
        """From one prediction to others [px], zero where nothing was measured."""
        return Parts(
            *(
                np.where(np.isfinite(measured)[None], np.nan_to_num(a - b), 0.0)
                for a, b, measured in zip(moved.parts, still.parts, self.measured.parts, strict=True)
            )
        )

    def settle_noise(self, fit: Fit, order: int = 2) -> None:
        """Sets the noise to what changes from frame to frame in the residuals of a fit, in differences of this order."""
        told = self.predictor(self.poses(fit.hypothesis, fit.z[None]), fit.hypothesis.batch(fit.z[None]))
        # As they are: what the robust loss makes of large residuals bends less than they do.
        white = self.rigid(self.distances(told), None, 1e9)[0]
        self.measured, self.counts = settled(self.measured, self.measured.split(white), self.counts, order)
        self.noise = everywhere(self.measured, self.frames)

    def leave_out(self, told: Measured) -> bool:
        """Leaves out what ``told`` does not tell of outlines and whole masks; whether that is anything."""
        before, self.measured = self.measured, self.measured.without_what_lacks(told)
        self.__dict__.pop("facts", None)
        return self.measured.count < before.count

    def allow_chaos(self, fit: Fit, seed: int, excused: float = EXCUSED) -> None:
        """Adds the rollout's own jaggedness around a fit to the noise, as far as the fit leaves something of it.

        After contacts the paths of bodies jump with the smallest change of a parameter. Of three rollouts on a line, two
        of them a posterior standard deviation to either side, the second difference is what no least squares can follow.
        """
        z = np.clip(drawn(fit.z, fit.curvature, seed), *fit.hypothesis.bounds)
        told = self.predictor(self.poses(fit.hypothesis, z), fit.hypothesis.batch(z))
        white = self.measured.split(self.residuals(fit.hypothesis, fit.z[None])[0][0])
        counts = self.counts.of(self.measured.parts)
        left = Parts(*(w * sigma / np.sqrt(c) for w, sigma, c in zip(white, self.widths, counts, strict=True)))
        self.noise = jagged(self.measured, believed(jaggedness(told), left, excused), self.noise.background)

    def _slack(self, keep: np.ndarray | None, told: Hypothesis | None) -> Slack | None:
        if self._columns is None:
            return None
        own, excused = (None, None) if told is None else (told.slack, told.excused)
        return self._slacks.of(self._columns if own is None else own, excused, keep, self.measured.kept)

    @property
    def slack_columns(self) -> Float[np.ndarray, "residuals columns"]:
        """What the residuals may err by, one standard deviation a column."""
        return np.zeros((len(self.measured.objects), 0)) if self._columns is None else self._columns

    def known(self, fit: Fit) -> Float[np.ndarray, "residuals"]:
        """A fit's residuals of what was measured, without those of nodes."""
        return fit.residual[: len(self.measured.objects)]

    # --- residuals ------------------------------------------------------------------------------------------------
    def distances(self, prediction: Prediction) -> Parts:
        """Predicted minus measured [px]; NaN where nothing was measured."""
        measured = self.measured.parts
        away = Parts(*(told - seen for told, seen in zip(prediction.parts, measured, strict=True)))

        def missed(part: np.ndarray, seen: np.ndarray) -> np.ndarray:
            # An object that nothing shows any more, where a mask is, misses it by its whole size.
            return np.where(np.isnan(part) & np.isfinite(seen), 30.0, part)

        return away._replace(reach=missed(away.reach, measured.reach), moments=missed(away.moments, measured.moments))

    def whitened(
        self,
        distances: Parts,
        keep: Bool[np.ndarray, "frames"] | None,
        scale: float,
        hypothesis: Hypothesis | None = None,
    ) -> Float[np.ndarray, "batch residuals"]:
        """Robust residuals in noise widths; zero where nothing was measured, and in frames that are not kept.

        ``hypothesis``: whose they are, and what may err under it; None: what may err in the clip.
        """
        white, slack = self.rigid(distances, keep, scale), self._slack(keep, hypothesis)
        return white if slack is None else slack(white)

    @property
    def widths(self) -> Parts:
        """Standard deviations of each part, to be broadcast [px]."""
        noise, slow = self.noise, self.measured.freshness[:, :, None] ** -0.5
        return Parts(
            noise.edge[:, :, None] * slow, noise.flow[:, :, None, None], noise.moments * slow, noise.background
        )

    def rigid(
        self, distances: Parts, keep: Bool[np.ndarray, "frames"] | None, scale: float
    ) -> Float[np.ndarray, "batch residuals"]:
        """As ``whitened``, but nothing excuses what contacts err by."""
        counts = self.counts.of(distances)
        parts = [
            slowed(np.nan_to_num(raw) / sigma, scale * patience) * np.sqrt(count)
            for raw, sigma, count, patience in zip(distances, self.widths, counts, PATIENCE, strict=True)
        ]
        white = Parts(*parts).flat()
        return white if keep is None else white * self.measured.kept(keep)

    def expected(self, without: tuple[str, ...] = ()) -> float:
        """Sum of squares that noise alone would give; ``without`` some of the parts."""
        parts, fresh = self.measured.parts, self.measured.freshness[..., None]
        seen = Parts(*(np.isfinite(part).astype(float) for part in parts))
        seen = seen._replace(reach=seen.reach * fresh, moments=seen.moments * fresh)
        told = zip(Parts._fields, self.counts.of(parts), seen, strict=True)
        return max(sum(count * float(part.sum()) for name, count, part in told if name not in without), 1.0)

    def misfit(self, fit: Fit) -> float:
        """Mean square residual of the objects in noise widths."""
        seen = self.known(fit)[: self.measured.objects.size - self.measured.background.size]
        return float((seen**2).sum()) / self.expected(without=("background",))

    def rollout(self, batch: SceneBatch, frames: int) -> np.ndarray:
        """The simulator's, counted."""
        self.rollouts += len(batch) * frames / self.frames
        return self.simulator.rollout(batch, frames)

    def flown(self, batch: SceneBatch, keep: np.ndarray | None = None) -> Flight:
        """Rollouts, counted, and the states in which paths arrive at nodes; after what is kept, all stands still."""
        needed = self.frames if keep is None else min(int(np.flatnonzero(keep)[-1]) + 2, self.frames)
        if batch.restarts:
            self.rollouts += len(batch) * needed / self.frames
            poses, arrived = self.simulator.shot(batch, needed)
        else:
            poses, arrived = self.rollout(batch, needed), np.zeros((len(batch), 0, 13))
        return np.concatenate([poses, np.repeat(poses[:, -1:], self.frames - needed, 1)], 1), arrived

    def poses(self, hypothesis: Hypothesis, z: np.ndarray, keep: np.ndarray | None = None) -> np.ndarray:
        """Paths at the rows of ``z``."""
        return self.flown(hypothesis.batch(z), keep)[0]

    def shot(
        self, hypothesis: Hypothesis, batch: SceneBatch, keep: np.ndarray | None = None
    ) -> tuple[Float[np.ndarray, "batch frames objects 7"], Float[np.ndarray, "batch missed"]]:
        """Paths of candidates, and by how much they miss the begin of those after nodes [deviations]."""
        poses, arrived = self.flown(batch, keep)
        return poses, missed_by(hypothesis.nodes, arrived, batch.restarts)

    def residuals(self, hypothesis: Hypothesis, z: np.ndarray, keep=None, scale: float = SCALE):
        """(residuals (B, R), half their sum of squares with the prior (B,))."""
        poses, missed = self.shot(hypothesis, batch := hypothesis.batch(z), keep)
        prediction = self.predictor(poses, batch)
        white = np.concatenate([self.whitened(self.distances(prediction), keep, scale, hypothesis), missed], 1)
        cost = 0.5 * (white**2).sum(1) + 0.5 * (prior(hypothesis, z)[0] ** 2).sum(1)
        return white, np.where(prediction.bad, np.inf, cost)

    def jacobian(self, hypothesis: Hypothesis, z: np.ndarray, keep=None, scale: float = SCALE, size=STEPS[0]):
        """d residuals / d z (R, D) by differences towards the inside of the bounds; of those of no size nothing is simulated."""
        step = np.where(z + size > hypothesis.bounds[1], -size, size)
        told = beside(hypothesis, z, step, lambda batch: self.flown(batch, keep))
        white = self.rigid(self.distances(prediction := self.predictor(told.poses, told.batch)), keep, scale)
        change = np.where(told.felt[:, self.measured.objects], white[told.row] - white[0], 0.0)
        slack = self._slack(keep, hypothesis) or (lambda rows: rows)
        change = np.where(prediction.bad[told.row, None], 0.0, slack(change))
        change = np.concatenate([change, told.change_of_missed(missing(hypothesis.nodes))], 1)
        return (change / np.where(step, step, 1.0)[:, None]).T

    # --- least squares --------------------------------------------------------------------------------------------
    @remembered
    def fit(
        self,
        hypothesis: Hypothesis,
        z: np.ndarray,
        iterations: int = 12,
        keep=None,
        scale: float = SCALE,
        rival: float = np.inf,
        attempts: int | None = None,
        thorough: bool = True,
        passing: bool = False,
    ) -> Fit:
        """Levenberg-Marquardt from ``z`` with an ``Effort``."""
        effort = Effort(iterations, rival, attempts, thorough, passing)
        return self._descended(hypothesis, np.clip(z, *hypothesis.bounds), keep, scale, effort)

    @remembered
    def gone_on(self, fit: Fit, iterations: int, rival: float = np.inf, thorough: bool = True) -> Fit:
        """Levenberg-Marquardt from where it was interrupted, of a fit to all frames."""
        start = Standing(fit.z, fit.residual, fit.cost, fit.jacobian)
        return self._descended(fit.hypothesis, start, None, SCALE, Effort(iterations, rival, None, thorough))

    def _descended(self, hypothesis: Hypothesis, start, keep, scale: float, effort: Effort) -> Fit:
        told = self._differences(hypothesis, keep, scale)
        ended = descended(start, told, functools.partial(prior, hypothesis), effort)
        return self._finished(hypothesis, ended.z, ended.base, ended.slopes, keep, ended.ended)

    def _differences(self, hypothesis: Hypothesis, keep, scale: float) -> Differences:
        return Differences(
            lambda points: self.residuals(hypothesis, points, keep, scale),
            lambda z, size: self.jacobian(hypothesis, z, keep, scale, size),
            hypothesis.bounds,
        )

    def best_of(self, hypothesis: Hypothesis, points: Float[np.ndarray, "points dimension"], keep=None) -> np.ndarray:
        """The point with the least cost."""
        points = np.clip(points, *hypothesis.bounds)
        return points[int(np.argmin(self.residuals(hypothesis, points, keep)[1]))]

    @remembered
    def hop(self, fit: Fit, seed: int, rounds: int = 3, count: int = 64, keep=None, scale: float = SCALE) -> Fit:
        """Least squares again from better points around its end (``hopped``)."""
        told = functools.partial(self.residuals, fit.hypothesis, keep=keep, scale=scale)
        return hopped(fit, seed, rounds, count, told, lambda z: self.fit(fit.hypothesis, z, 6, keep, scale))

    @remembered
    def roam(self, fit: Fit, seed: int, widths: tuple[float, ...] = ROAMED) -> Fit:
        """Least squares from where an evolution strategy ends that begins at a fit, in its posterior's coordinates; ``widths``:
        of each round's first generation [posterior standard deviations]."""
        for width in widths:
            strategy = Strategy(len(fit.z), width, seed)
            best, point = looked_around(fit, strategy, functools.partial(self.residuals, fit.hypothesis))
            if best < fit.cost:
                trial = self.fit(fit.hypothesis, point, 8)
                fit = trial if trial.cost < fit.cost else fit
        return fit

    def _finished(self, hypothesis: Hypothesis, z, base, jacobian, keep=None, ended: bool = True) -> Fit:
        data = 0.5 * float(base @ base)
        price_of_z, slope = prior(hypothesis, z)
        cost = data + 0.5 * float(price_of_z @ price_of_z)
        logdet = float(np.linalg.slogdet(jacobian.T @ jacobian + np.diag(slope**2))[1])
        price = hypothesis.price + (slack.price if (slack := self._slack(keep, hypothesis)) else 0.0)
        return Fit(hypothesis, z, cost, data, jacobian, base, -cost - 0.5 * logdet - price, ended)

    def at(self, hypothesis: Hypothesis, z: np.ndarray, keep=None, scale: float = SCALE, doubted: bool = False) -> Fit:
        """No step, just what holds at ``z``; ``doubted``: with larger differences, too (``Differences.surest``)."""
        (base,), _ = self.residuals(hypothesis, z[None], keep, scale)
        told = self._differences(hypothesis, keep, scale)
        return self._finished(hypothesis, z, base, told.surest(z, base, doubted), keep)


def _made(shapes: tuple[Shape, ...], fps: float, measured: Measured, image, frames: int, threads: int) -> ClipFit:
    return ClipFit(Recalling(MujocoSimulator(shapes, fps, threads)), measured, image, frames)
