"""Base parameters from hypothesis to hypothesis: one basin is fair to all.

Evidence compares hypotheses, but least squares after contacts compares where each happened to end. So every hypothesis may
begin again from what the best of the others found for the parameters that they share, with its own effect or without it.
"""

from __future__ import annotations

import numpy as np

from mjx_refine.diagnosis.fit import ClipFit, Fit

SOURCES = 3
"""How many fits give their base parameters."""

TAKERS = 6
"""How many hypotheses try them."""

ITERATIONS = 6
"""Of least squares from the best of them."""

NEAR = 1.3
"""How much a point may cost, as a multiple of the hypothesis' own fit, for least squares to begin there."""

Key = tuple[str, int]
Fitted = dict[Key, tuple[Fit, float]]


def exchanged(clip: ClipFit, base: Fit, fitted: Fitted) -> tuple[Fit, Fitted]:
    """The base model's fit and the effects' (with what the linear look promised), none worse than before."""
    ordered = sorted(fitted, key=lambda key: -fitted[key][0].evidence)
    count = base.hypothesis.dimension
    sources = [base.z, *(fitted[key][0].z[:count] for key in ordered[:SOURCES])]
    better = _again(clip, base, sources, count)
    takers = ordered[:TAKERS]
    fits = clip.crew.each(clip, _again, [(fitted[key][0], [better.z, *sources], count) for key in takers])
    return better, {**fitted, **{key: (fit, fitted[key][1]) for key, fit in zip(takers, fits, strict=True)}}


def _again(clip: ClipFit, fit: Fit, sources: list[np.ndarray], count: int) -> Fit:
    own = fit.z[count:]
    points = [np.concatenate([z, part]) for z in sources for part in ([own, 0 * own] if len(own) else [own])]
    points = np.array([point for point in points if not np.array_equal(point, fit.z)])
    if not len(points):
        return fit
    costs = clip.residuals(fit.hypothesis, points)[1]
    best = int(np.argmin(costs))
    if not costs[best] < NEAR * fit.cost:
        return fit
    again = clip.fit(fit.hypothesis, points[best], ITERATIONS)
    return again if again.evidence > fit.evidence else fit
