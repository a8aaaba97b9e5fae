"""The linear look ahead over several clips: what an effect that they share would gain in all of them together."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.fit import SCALE
from mjx_refine.diagnosis.joint.arrow import Arrow
from mjx_refine.diagnosis.joint.fit import Clips, JointFit
from mjx_refine.diagnosis.search.screen import Lead, Screen, distinct, families_of
from mjx_refine.effects import catalogue
from mjx_refine.effects.kind import EffectKind, FitView, Start

MOST_STARTS = 24
"""Starts of one family that all clips look at: where each clip's own look finds many places, the best of each, spread over
the clips."""


class JointScreen:
    """Looks ahead from one joint fit.

    Args:
      clips: residuals.
      fit: where to look from.
      views: of each clip, for kinds to propose starts.
      scale: of the robust loss that the fit was made with [noise widths].
    """

    def __init__(self, clips: Clips, fit: JointFit, views: list[FitView], scale: float = SCALE):
        self.clips, self.fit, self.views = clips, fit, views
        self.curvature: Arrow = fit.curvature
        self.gradient = fit.gradient
        told = zip(clips.clips, fit.parts, views, strict=True)
        self.screens = [Screen(clip, part, view, scale) for clip, part, view in told]

    def leads(self, names: list[str]) -> list[Lead]:
        """The best few starts of every effect and target, most promising first; their ``shift`` is of joint coordinates."""
        found: list[Lead] = []
        for name, target in families_of(names, self.views[0]):
            found += self._family(catalogue()[name], target)
        return sorted(found, key=lambda lead: -lead.gain)

    def _family(self, kind: EffectKind, target: int) -> list[Lead]:
        starts = self._starts(kind, target)
        if not starts:
            return []
        rows = [screen.predicted(kind, target, starts) for screen in self.screens]
        result, first = [], 0
        for start in starts:
            count = max(len(start.columns), 1)
            part = [white[first : first + count] for white in rows]
            first += count
            result.append(self._lead(kind, target, start, part))
        return distinct(sorted(result, key=lambda lead: -lead.gain))

    def _starts(self, kind: EffectKind, target: int) -> list[Start]:
        """Starts that depend on no clip, or those that each clip's own look finds best."""
        each = [kind.starts(view, target) for view in self.views]
        if all(len(starts) <= 1 for starts in each):
            return next((starts for starts in each if starts), [])
        found: list[list[Start]] = []
        for screen, starts in zip(self.screens, each, strict=True):
            leads = screen.looked(kind, target, starts) if starts else []
            found.append([lead.start for lead in leads])
        most = max(len(starts) for starts in each)
        # Turn by turn, so that no clip is left out.
        turns = [starts[k] for k in range(max(map(len, found), default=0)) for starts in found if len(starts) > k]
        kept: list[Start] = []
        for start in turns:
            width = start.width if start.width is not None else np.ones(len(start.values))
            if all(np.abs((start.values - other.values) / width).max() > 0.5 for other in kept):
                kept.append(start)
            if len(kept) == MOST_STARTS:
                break
        # Looked for in every clip's places: their number is the price.
        return [_priced(start, most * len(self.views)) for start in kept]

    def _lead(self, kind: EffectKind, target: int, start: Start, white: list[np.ndarray]) -> Lead:
        fit, price = self.fit, float(np.log(start.places))
        if not start.columns:
            gain, shift = self._finite([row[0] for row in white])
            return Lead(kind.name, target, start, gain - price, np.zeros(0), shift)
        width = start.width if start.width is not None else np.ones(len(start.values))
        steps = np.array([step for _, step in start.columns])
        scale = np.array([width[k] for k, _ in start.columns])
        columns = [(w - p.residual).T / (steps / scale) for w, p in zip(white, fit.parts, strict=True)]
        coupling = self._joint([p.jacobian.T @ c for p, c in zip(fit.parts, columns, strict=True)])
        eased = self.curvature.solve(np.concatenate([coupling, self.gradient[:, None]], 1))
        curvature = sum(c.T @ c for c in columns) - coupling.T @ eased[:, :-1] + np.eye(len(steps))
        direct = sum(c.T @ p.residual for c, p in zip(columns, fit.parts, strict=True))
        gradient = coupling.T @ eased[:, -1] - direct
        step = np.linalg.solve(curvature, gradient)
        gain = 0.5 * float(gradient @ step) - 0.5 * float(np.linalg.slogdet(curvature)[1])
        shift = -(eased[:, :-1] @ step + eased[:, -1])
        return Lead(kind.name, target, start, gain - price, step * scale, shift)

    def _finite(self, white: list[np.ndarray]) -> tuple[float, np.ndarray]:
        """Gain of a finite change once the base parameters have adapted to it, linearly, and that adaptation."""
        fit, before = self.fit, self.gradient
        change = [p.jacobian.T @ (w - p.residual) for w, p in zip(white, fit.parts, strict=True)]
        gradient = before + self._joint(change)
        eased = self.curvature.solve(np.stack([gradient, before], 1))
        now = fit.cost - fit.data + 0.5 * sum(float(w @ w) for w in white) - 0.5 * float(gradient @ eased[:, 0])
        return fit.cost - 0.5 * float(before @ eased[:, 1]) - now, -eased[:, 0]

    def _joint(self, parts: list[np.ndarray]) -> Float[np.ndarray, "dimension columns"]:
        result = np.zeros((self.fit.hypothesis.dimension, *parts[0].shape[1:]))
        for part, index in zip(parts, self.fit.hypothesis.index, strict=True):
            result[index] += part
        return result


def _priced(start: Start, places: int) -> Start:
    return dataclasses.replace(start, places=places)
