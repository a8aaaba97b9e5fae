"""Base parameters from hypothesis to hypothesis: one basin is fair to all.

Evidence compares hypotheses, but least squares after contacts compares where each happened to end. So every hypothesis may
begin again from what the best of the others found for the parameters that they share, with its own effect or without it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from mjx_refine.diagnosis.fits.candidates import Candidate, in_order, lead_of
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.knock import knocked

SOURCES = 3
"""How many fits give their base parameters."""

TAKERS = 6
"""How many hypotheses try them."""

ITERATIONS = 6
"""Of least squares from the best of them."""

NEAR = 1.3
"""How much a point may cost, as a multiple of the hypothesis' own fit, for least squares to begin there."""

ALONE = 10
"""Of one of two effects, from what both found together."""

Key = tuple[str, int]
Fitted = dict[Key, tuple[Fit, float]]


def exchanged(clip: ClipFit, base: Fit, fitted: Fitted) -> tuple[Fit, Fitted]:
    """The base model's fit and the effects' (with what the linear look promised), none worse than before."""
    ordered = sorted(fitted, key=lambda key: -fitted[key][0].evidence)
    count = base.hypothesis.dimension
    sources = [base, *(fitted[key][0] for key in ordered[:SOURCES])]
    better = begun_again(clip, base, sources, count)
    takers = ordered[:TAKERS]
    fits = clip.crew.each(clip, begun_again, [(fitted[key][0], [better, *sources], count) for key in takers])
    return better, {**fitted, **{key: (fit, fitted[key][1]) for key, fit in zip(takers, fits, strict=True)}}


def begun_again(clip: ClipFit, fit: Fit, sources: list[Fit], count: int) -> Fit:
    """The fit, or a better one from ordinary numbers that others found; ``count``: how many these are."""
    best, least = None, NEAR * fit.cost
    for source in sources:
        # Near the source's path contacts may err as they may there.
        hypothesis = dataclasses.replace(fit.hypothesis, slack=source.hypothesis.slack)
        own = fit.z[count:]
        points = [np.concatenate([source.z[:count], part]) for part in ([own, 0 * own] if len(own) else [own])]
        points = np.array([point for point in points if not np.array_equal(point, fit.z)])
        if len(points):
            costs = clip.residuals(hypothesis, points)[1]
            if costs.min() < least:
                best, least = (hypothesis, points[int(np.argmin(costs))]), float(costs.min())
    if best is None:
        return fit
    again = knocked(clip, clip.fit(*best, ITERATIONS, thorough=False))
    return again if again.evidence > fit.evidence else fit


def at_least_nothing(clip: ClipFit, base: Fit, fitted: Fitted) -> Fitted:
    """Fits that ended above what their effect gives at size nothing stand there instead: an effect of no size is the base model,
    so that is where they could have ended, and their derivatives there say what size the clip rules out."""
    behind = [key for key, (fit, _) in fitted.items() if fit.cost > base.cost]
    fits = clip.crew.each(clip, _of_nothing, [(base, fitted[key][0]) for key in behind])
    return {**fitted, **{key: (fit, fitted[key][1]) for key, fit in zip(behind, fits, strict=True)}}


def _of_nothing(clip: ClipFit, base: Fit, fit: Fit) -> Fit:
    hypothesis = dataclasses.replace(base.hypothesis, terms=fit.hypothesis.terms)
    there = clip.at(hypothesis, np.concatenate([base.z, np.zeros(hypothesis.dimension - len(base.z))]))
    return there if there.evidence > fit.evidence else fit


def held_against(clip: ClipFit, base: Fit, kept: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Candidates by how far they lead ``base``, at no size where they end behind it."""
    ends = at_least_nothing(clip, base, {("", k): (one.fit, one.promise) for k, one in enumerate(kept)})
    return in_order(clip, [Candidate(fit, lead_of(fit, base), promise) for fit, promise in ends.values()])


def alone(clip: ClipFit, fit: Fit, k: int) -> Fit:
    """Effect ``k`` of several by itself, fitted from what they found together."""
    hypothesis, count = fit.hypothesis, fit.hypothesis.ground
    ends = count + np.cumsum([int(t.free.sum()) for t in hypothesis.terms])
    own = fit.z[ends[k] - int(hypothesis.terms[k].free.sum()) : ends[k]]
    single = dataclasses.replace(hypothesis, terms=(hypothesis.terms[k],))
    return knocked(clip, clip.fit(single, np.concatenate([fit.z[:count], own]), ALONE, thorough=False))
