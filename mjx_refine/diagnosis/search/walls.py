"""An obstacle in the place of a push: what a push explains, something that the object hits may explain better."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.knock import excuses, knocked
from mjx_refine.diagnosis.search.screen import term_of
from mjx_refine.effects.hidden_obstacle import HiddenObstacle
from mjx_refine.effects.kind import FitView

TURNS, FACINGS = (-60.0, -45.0, -30.0, -15.0, 0.0, 15.0, 30.0, 45.0, 60.0), 2
"""How far an obstacle's face may be turned from a push's impulse, since it rubs, where fits look [degree]; from how many
of these they begin, beside the one that is not turned."""

ITERATIONS = 9
"""Of least squares from each."""

PATIENCE = 1.5
"""Multiplies what an obstacle may cost before its fit is given up: its impact may not err yet, which explains more."""


def walls_from_pushes(
    clip: ClipFit, pushes: Sequence[tuple[Fit, FitView, float]], told: Callable[[str], None], lines: Sequence[str]
) -> list[Fit | None]:
    """For each fit, whose last effect is a push, the best with an obstacle in its place; None where its rollout diverged.

    Args:
      clip: residuals.
      pushes: the fits, what is seen of the clip, and what the hypothesis without the push costs.
      told: called with the line of a fit that is looked at.
      lines: one a fit.
    """
    begun = clip.crew.each(clip, _facings, [(fit, view) for fit, view, _ in pushes], told, lines)
    rows = [(k, *start, e) for k, starts in enumerate(begun) for start in starts for e in (False, True)]
    rivals = [rival for _, _, rival in pushes]
    fits = clip.crew.each(clip, _fitted, [(hypothesis, z, rivals[k], erring) for k, hypothesis, z, erring in rows])
    # Of those that begin elsewhere the best goes on: of either kind, since the impacts of one could not err yet.
    best = _best_of([(k, erring) for k, _, _, erring in rows], fits)
    ended = clip.crew.each(clip, knocked, [(fit, rivals[k]) for (k, _), fit in best.items()])
    walls = _best_of([k for k, _ in best], ended)
    return [walls.get(k) for k in range(len(pushes))]


def _best_of(keys: Sequence[Any], fits: Sequence[Fit]) -> dict[Any, Fit]:
    """The fit with the most evidence of every key."""
    best: dict[Any, Fit] = {}
    for key, fit in zip(keys, fits, strict=True):
        best[key] = max(best.get(key, fit), fit, key=lambda one: one.evidence)
    return best


def push_last(fit: Fit) -> Fit:
    """The fit with a push as its last effect; its derivatives are not to be used."""
    hypothesis = fit.hypothesis
    order = sorted(range(len(hypothesis.terms)), key=lambda k: hypothesis.terms[k].name == "push")
    counts = [hypothesis.ground, *(int(t.free.sum()) for t in hypothesis.terms)]
    base, *own = np.split(fit.z, np.cumsum(counts)[:-1])
    terms = tuple(hypothesis.terms[k] for k in order)
    return dataclasses.replace(
        fit,
        hypothesis=dataclasses.replace(hypothesis, terms=terms),
        z=np.concatenate([base, *(own[k] for k in order)]),
    )


def _facings(clip: ClipFit, fit: Fit, view: FitView) -> list[tuple[Hypothesis, np.ndarray]]:
    """Where fits with an obstacle begin: it faces about along the push's impulse, about when that was."""
    *others, push = fit.hypothesis.terms
    rest = dataclasses.replace(fit.hypothesis, terms=tuple(others))
    time, x, y, _ = fit.hypothesis.values(fit.z[None], len(others))[0]
    frame = int(np.clip(round(time * view.fps + 0.25), 0, clip.frames - 1))
    poses = clip.poses(fit.hypothesis, fit.z[None])[0]
    if not np.isfinite(poses).all():
        return []
    there = dataclasses.replace(view, poses=poses)
    along = float(np.degrees(np.arctan2(y, x)))
    moments = sorted({int(np.clip(frame + k, 0, clip.frames - 1)) for k in (-1, 0, 1)})
    starts = [HiddenObstacle().facing(there, push.target, t, along + turn) for turn in TURNS for t in moments]
    one = term_of("hidden_obstacle", push.target, dataclasses.replace(starts[0], places=clip.frames), clip.frames)
    hypothesis = rest.added(one)
    own = one.at(np.array([start.values for start in starts]))
    points = np.concatenate([np.repeat(fit.z[None, : rest.dimension], len(own), 0), own], 1)
    costs = clip.residuals(hypothesis, points)[1].reshape(len(TURNS), -1)
    facing = {*np.argsort(costs.min(1))[:FACINGS].tolist(), TURNS.index(0.0)}
    return [(hypothesis, points[k * len(moments) + int(np.argmin(costs[k]))]) for k in sorted(facing)]


def _fitted(clip: ClipFit, hypothesis: Hypothesis, z: np.ndarray, rival: float, erring: bool) -> Fit:
    """An obstacle's fit; ``erring``: its impact errs from the first step on, and not only once its place is found."""
    if erring:
        *others, wall = hypothesis.terms
        wall = dataclasses.replace(wall, excused=excuses(clip, hypothesis, z, len(others)))
        hypothesis = dataclasses.replace(hypothesis, terms=(*others, wall))
    return clip.fit(hypothesis, z, ITERATIONS, rival=PATIENCE * rival, thorough=False)
