"""A patch of the floor in the place of a push: what changes a sliding body's velocity may be what it slides on."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.knock import knocked
from mjx_refine.diagnosis.search.screen import term_of
from mjx_refine.effects.friction_patch import FrictionPatch
from mjx_refine.effects.kind import FitView

BEGUN, LOOK, ITERATIONS = 3, 5, 12
"""From how many of the patches fits begin with either ordinary numbers, after how many steps the best of these goes on, and for
how long."""


def patches_from_pushes(clip: ClipFit, pushes: Sequence[tuple[Fit, FitView]]) -> list[Fit | None]:
    """For each fit, whose last effect is a push, the best with a patch in its place that is crossed about then; None where its
    object is not on the floor."""
    begun = clip.crew.each(clip, _crossings, list(pushes))
    fits = iter(clip.crew.each(clip, _fitted, [(*row, LOOK) for rows in begun for row in rows]))
    best = [max((next(fits) for _ in rows), key=lambda fit: fit.evidence, default=None) for rows in begun]
    there = [fit for fit in best if fit is not None]
    ended = iter(clip.crew.each(clip, _fitted, [(fit.hypothesis, fit.z, ITERATIONS) for fit in there]))
    return [None if fit is None else next(ended) for fit in best]


def _crossings(clip: ClipFit, fit: Fit, view: FitView) -> list[tuple[Hypothesis, np.ndarray]]:
    *others, push = fit.hypothesis.terms
    rest = dataclasses.replace(fit.hypothesis, terms=tuple(others))
    time = float(fit.hypothesis.values(fit.z[None], len(others))[0, 0])
    poses = clip.poses(fit.hypothesis, fit.z[None])[0]
    if not np.isfinite(poses).all():
        return []
    frame = int(np.clip(round(time * view.fps), 0, clip.frames - 1))
    starts = FrictionPatch().crossed(dataclasses.replace(view, poses=poses), push.target, frame)
    if not starts:
        return []
    terms = [term_of("friction_patch", -1, start, clip.frames) for start in starts]
    owns, nothing = terms[0].at(np.array([one.centre for one in terms])), np.zeros(len(terms[0].centre))
    found = []
    # A push that ended badly has bent the ordinary numbers, and the given scene's are bent by nothing.
    plain = rest.space.dimension
    beside = fit.z[plain : rest.dimension]
    for ground in (fit.z[: rest.dimension], np.concatenate([np.zeros(plain), beside])):
        at = [np.concatenate([ground, own]) for own in owns]
        white, costs = clip.residuals(rest.added(terms[0]), np.array(at))
        # Without the prior, which is the first one's.
        left = np.where(np.isfinite(costs), (white**2).sum(1), np.inf)
        best = np.argsort(left, kind="stable")[:BEGUN]
        found += [(rest.added(terms[k]), np.concatenate([ground, nothing])) for k in best]
    return found


def _fitted(clip: ClipFit, hypothesis: Hypothesis, z: np.ndarray, iterations: int) -> Fit:
    fit = clip.fit(hypothesis, z, iterations, thorough=False)
    return knocked(clip, fit) if iterations > LOOK else fit
