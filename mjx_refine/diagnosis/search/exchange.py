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

SURE, DOUBTED = 4, 15.0
"""How many hypotheses are weighed by derivatives that larger differences tell, too, and what they must gain on the base model, in
evidence or in cost. (Of three objects that collide the same numbers, with an effect of no size, had 8 less by the smallest
differences, whose jags were not seen there, than by larger ones.)"""

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


def surely(clip: ClipFit, base: Fit, fitted: Fitted) -> tuple[Fit, Fitted]:
    """The base model's fit and those that gain on it, the best few, with derivatives told by larger differences, too.

    A jag that derivatives tell makes the posterior seem narrower than it is, and evidence less. Where that is so for one
    hypothesis and not for another, what leads need not explain more.
    """
    gains = {key: max(fit.evidence - base.evidence, base.cost - fit.cost) for key, (fit, _) in fitted.items()}
    first = [key for key in sorted(gains, key=lambda key: -gains[key]) if gains[key] > DOUBTED][:SURE]
    if not first:
        return base, fitted
    base, *fits = clip.crew.each(clip, _surely, [(base,), *((fitted[key][0],) for key in first)])
    return base, {**fitted, **{key: (fit, fitted[key][1]) for key, fit in zip(first, fits, strict=True)}}


def _surely(clip: ClipFit, fit: Fit) -> Fit:
    return clip.at(fit.hypothesis, fit.z, doubted=True)


def held_against(
    clip: ClipFit, base: Fit, singles: Sequence[Candidate], pairs: Sequence[Candidate] = ()
) -> tuple[Fit, tuple[Candidate, ...], tuple[Candidate, ...]]:
    """The base model's fit, and candidates by how far they lead it, at no size where they end behind it."""
    kept = [*singles, *pairs]
    ends = at_least_nothing(clip, base, {("", k): (one.fit, one.promise) for k, one in enumerate(kept)})
    base, ends = surely(clip, base, ends)
    told = [Candidate(fit, lead_of(fit, base), promise) for fit, promise in ends.values()]
    return base, in_order(clip, told[: len(singles)]), in_order(clip, told[len(singles) :])


def alone(clip: ClipFit, fit: Fit, k: int) -> Fit:
    """Effect ``k`` of several by itself, fitted from what they found together."""
    hypothesis, count = fit.hypothesis, fit.hypothesis.ground
    ends = count + np.cumsum([int(t.free.sum()) for t in hypothesis.terms])
    own = fit.z[ends[k] - int(hypothesis.terms[k].free.sum()) : ends[k]]
    single = dataclasses.replace(hypothesis, terms=(hypothesis.terms[k],))
    return knocked(clip, clip.fit(single, np.concatenate([fit.z[:count], own]), ALONE, thorough=False))
