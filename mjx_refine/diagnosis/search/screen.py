"""A linear look ahead: what every effect, at every place where it may begin, would gain (Rao's score test 1948)."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.fit import SCALE, ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, Term, term
from mjx_refine.effects import catalogue
from mjx_refine.effects.kind import EffectKind, FitView, Start

MOST_ROWS = 96
"""Candidates predicted at a time."""

AWAY = (-2.0, -1.0, 1.0, 2.0)
"""Prior widths of an effect's parameters at which fits begin that the linear look would not."""


@dataclasses.dataclass(frozen=True)
class Lead:
    """A start and what it promises.

    Attributes:
      name: the effect.
      target: the object, or -1.
      start: where to begin.
      gain: of evidence, by the linear look.
      step: of the varied parameters, in their own units.
      shift: of the base parameters that goes with it.
      whole: whether the fit begins with the whole step, and not with as much of it as serves.
    """

    name: str
    target: int
    start: Start
    gain: float
    step: Float[np.ndarray, "columns"]
    shift: Float[np.ndarray, "dimension"]
    whole: bool = False

    def term(self, frames: int) -> Term:
        """The hypothesis' term."""
        return term_of(self.name, self.target, self.start, frames)

    def z(self, one: Term) -> Float[np.ndarray, "free"]:
        """Where the fit begins, in the term's free coordinates."""
        full = np.zeros(len(one.centre))
        for (k, _), step in zip(self.start.columns, self.step, strict=True):
            full[k] = np.clip(step / one.width[k], -4.0, 4.0)
        return full[one.free]


def families_of(names: list[str], view: FitView) -> list[tuple[str, int]]:
    """Every effect with each of its targets; -1: it has no single one."""
    targets = range(len(view.batch.shapes))
    return [(name, target) for name in names for target in (targets if catalogue()[name].targeted else (-1,))]


def term_of(name: str, target: int, start: Start, frames: int) -> Term:
    """The term of a start."""
    one = term(name, target, frames, start.values)
    free = one.free.copy()
    free[list(start.fixed)] = False
    width = one.width if start.width is None else start.width
    one = dataclasses.replace(one, width=width, free=free, places=start.places)
    if start.pivot is None:
        return one
    return dataclasses.replace(one, pivot=start.pivot, centre=one.kind.to_pivot(one.centre[None], start.pivot)[0])


class Screen:
    """Looks ahead from one fit.

    Args:
      clip: the clip's residuals.
      fit: where to look from.
      view: what kinds need to know to propose starts.
      scale: of the robust loss that the fit was made with [noise widths].
      poses: of the fit, where they are known.
    """

    def __init__(self, clip: ClipFit, fit: Fit, view: FitView, scale: float = SCALE, poses: np.ndarray | None = None):
        self.clip, self.fit, self.view, self.scale = clip, fit, view, scale
        self.inverse = np.linalg.inv(fit.curvature)
        self.poses = clip.poses(fit.hypothesis, fit.z[None]) if poses is None else poses

    def leads(self, names: list[str]) -> list[Lead]:
        """The best few starts of every effect and target, most promising first."""
        found = [lead for leads in self.clip.crew.each(self.clip, _family, self._rows(names)) for lead in leads]
        return sorted(found, key=lambda lead: -lead.gain)

    def away(self, names: list[str]) -> list[Lead]:
        """For every effect that ordinary parameters imitate, and every target, the most promising start with much of it, the
        most promising of these first.

        They imitate it by what else its derivative is made of, and a fit that has bent them so stays there; from much of the
        effect it does not.
        """
        imitated = [name for name in names if catalogue()[name].imitated]
        return sorted(self.clip.crew.each(self.clip, _far, self._rows(imitated)), key=lambda lead: -lead.gain)

    def _rows(self, names: list[str]) -> list[tuple]:
        """What a process needs to look ahead, for every effect and target."""
        return [(self.fit, self.view, self.scale, self.poses, *family) for family in families_of(names, self.view)]

    def far(self, kind: EffectKind, target: int) -> Lead:
        """The most promising of some widths of every parameter of one effect and target."""
        still = kind.still(self.view, target)
        width = kind.widths(self.view, target)
        steps = np.array([a * float(width[k]) * np.eye(len(still.values))[k] for k, _ in still.columns for a in AWAY])
        white = self.predicted(
            kind, target, [dataclasses.replace(still, values=still.values + s, columns=()) for s in steps]
        )
        told = [self._finite(row) for row in white]
        best = max(range(len(told)), key=lambda k: told[k][0])
        gain, shift = told[best]
        return Lead(kind.name, target, still, gain, steps[best][[k for k, _ in still.columns]], shift, whole=True)

    def looked(self, kind: EffectKind, target: int, starts: list[Start]) -> list[Lead]:
        """The best few of some starts of one effect and target."""
        white = self.predicted(kind, target, starts)
        result, row = [], 0
        for start in starts:
            count = max(len(start.columns), 1)
            part = white[row : row + count]
            row += count
            result.append(self._lead(kind, target, start, part))
        return distinct(sorted(result, key=lambda lead: -lead.gain))

    def predicted(self, kind: EffectKind, target: int, starts: list[Start]) -> np.ndarray:
        """Residuals at every start's steps, (rows, R)."""
        frames = self.clip.frames
        rows: list[np.ndarray] = []
        for start in starts:
            if not start.columns:
                rows.append(start.values)
            for k, step in start.columns:
                row = start.values.copy()
                row[k] += step
                rows.append(row)
        one = dataclasses.replace(term(kind.name, target, frames, starts[0].values), free=np.zeros(len(rows[0]), bool))
        hypothesis = self.fit.hypothesis.added(one)
        acts = kind.physical or kind.retimes
        parts = []
        for first in range(0, len(rows), MOST_ROWS):
            values = np.array(rows[first : first + MOST_ROWS])
            z = np.repeat(self.fit.z[None], len(values), 0)
            parts.append(self._white(hypothesis, z, values, acts))
        return np.concatenate(parts)

    def _white(self, hypothesis: Hypothesis, z: np.ndarray, values: np.ndarray, acts: bool) -> np.ndarray:
        batch = hypothesis.batch(z)
        effects = (*batch.effects[:-1], dataclasses.replace(batch.effects[-1], values=values))
        # A slope carries its objects along; its batch must be made with its values.
        batch = hypothesis.batch_with(z, effects)
        if acts:
            poses, missed = self.clip.shot(hypothesis, batch)
        else:
            poses = np.repeat(self.poses, len(z), 0)
            missed = np.repeat(self.fit.residual[None, len(self.clip.known(self.fit)) :], len(z), 0)
        prediction = self.clip.predictor(poses, batch)
        white = self.clip.whitened(self.clip.distances(prediction), None, self.scale, self.fit.hypothesis)
        return np.where(prediction.bad[:, None], 1e3, np.concatenate([white, missed], 1))

    def _lead(self, kind: EffectKind, target: int, start: Start, white: np.ndarray) -> Lead:
        fit, price = self.fit, float(np.log(start.places))
        if not start.columns:
            gain, shift = self._finite(white[0])
            return Lead(kind.name, target, start, gain - price, np.zeros(0), shift)
        width = start.width if start.width is not None else np.ones(len(start.values))
        steps = np.array([step for _, step in start.columns])
        scale = np.array([width[k] for k, _ in start.columns])
        columns = (white - fit.residual).T / (steps / scale)
        projected = columns - fit.jacobian @ (self.inverse @ (fit.jacobian.T @ columns))
        curvature = columns.T @ projected + np.eye(len(steps))
        gradient = -columns.T @ (fit.residual - fit.jacobian @ (self.inverse @ fit.gradient))
        step = np.linalg.solve(curvature, gradient)
        gain = 0.5 * float(gradient @ step) - 0.5 * float(np.linalg.slogdet(curvature)[1])
        shift = -self.inverse @ (fit.jacobian.T @ (columns @ step) + fit.gradient)
        return Lead(kind.name, target, start, gain - price, step * scale, shift)

    def _finite(self, white: np.ndarray) -> tuple[float, np.ndarray]:
        """Gain of a finite change once the base parameters have adapted to it, linearly, and that adaptation."""
        fit = self.fit
        before = fit.gradient
        gradient = before + fit.jacobian.T @ (white - fit.residual)
        now = fit.cost - fit.data + 0.5 * float(white @ white) - 0.5 * float(gradient @ self.inverse @ gradient)
        return fit.cost - 0.5 * float(before @ self.inverse @ before) - now, -self.inverse @ gradient


def _family(
    clip: ClipFit, fit: Fit, view: FitView, scale: float, poses: np.ndarray, name: str, target: int
) -> list[Lead]:
    kind = catalogue()[name]
    starts = kind.starts(view, target)
    return Screen(clip, fit, view, scale, poses).looked(kind, target, starts) if starts else []


def _far(clip: ClipFit, fit: Fit, view: FitView, scale: float, poses: np.ndarray, name: str, target: int) -> Lead:
    return Screen(clip, fit, view, scale, poses).far(catalogue()[name], target)


def distinct(leads: list[Lead], most: int = 3) -> list[Lead]:
    """The best few that do not begin at nearly the same place."""
    result: list[Lead] = []
    for lead in leads:
        width = lead.start.width if lead.start.width is not None else np.ones(len(lead.start.values))
        if all(np.abs((lead.start.values - other.start.values) / width).max() > 1.5 for other in result):
            result.append(lead)
        if len(result) == most:
            break
    return result
