"""Which leads of the linear look are fitted, and where their fits begin."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_refine.diagnosis.fits.fit import SCALE, ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.search.screen import Lead

FORGIVING, FIRST = 40.0, 7
"""Scale of the robust loss while a fit is far off [noise widths], and steps that are made with it."""

PROMISE = 2.0
"""Evidence that the linear look must promise for a family to be fitted."""


def chosen_of(leads: list[Lead], families: int, starts: int = 2) -> list[Lead]:
    """The best starts of the best families: several where place or moment matter, else one."""
    kept: dict[tuple[str, int], list[Lead]] = {}
    for lead in leads:
        family = kept.setdefault((lead.name, lead.target), [])
        if len(family) < (starts if lead.start.places > 1 else 1):
            family.append(lead)
    best = [family for family in kept.values() if family[0].gain > PROMISE][:families]
    return [lead for family in best for lead in family]


def beginning(clip: ClipFit, hypothesis: Hypothesis, base: Fit, lead: Lead, z: np.ndarray) -> np.ndarray:
    """Where the fit starts: a part of the way that the linear look points, base parameters and effect together."""
    parts = (0.0, 0.1, 0.3, 0.6, 1.0) if lead.start.columns else (0.0, 0.3, 1.0)
    limited = np.clip(lead.shift, -10.0, 10.0)
    points = [np.concatenate([base.z + a * limited, z if lead.whole else a * z]) for a in parts]
    return clip.best_of(hypothesis, np.array(points))


def begun(clip: ClipFit, here: Fit, lead: Lead, scale: float) -> tuple[Hypothesis, np.ndarray]:
    """A lead's hypothesis and where its fit starts; after some steps with the loss of ``scale``, where that forgives more."""
    one = lead.term(clip.frames)
    hypothesis = here.hypothesis.added(one)
    z = beginning(clip, hypothesis, here, lead, lead.z(one))
    if scale <= SCALE:
        return hypothesis, z
    fit = clip.fit(hypothesis, z, FIRST, scale=scale, thorough=False, passing=True)
    # Far from where it began, contacts are others.
    return dataclasses.replace(hypothesis, slack=clip.slack_along(fit)), fit.z
