"""Frames that are missing or doubled near an impact, which the state that an object goes on from after it would take in."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.candidates import Candidate, lead_of
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.knock import knocked
from mjx_refine.diagnosis.search.screen import Lead, Screen
from mjx_refine.effects.kind import FitView

NAME = "dropped_frames"

PROMISED, ITERATIONS, ROUNDS = 60.0, 8, 4
"""Evidence that the linear look must promise and the fit must lead by, iterations of least squares, and how often the frame and
the count beside the best are tried. The first was chosen once frames missing at impacts of two clips had promised 240 and 461,
and four clips without any 9 at most; the others were not tried otherwise."""


def lost_frames(clip: ClipFit, base: Fit, view: FitView) -> tuple[Candidate, ...]:
    """Frames missing or doubled beside the base model without states of its own, where much speaks for them; else nothing."""
    leads = [lead for lead in Screen(clip, base, view).leads([NAME]) if lead.gain > PROMISED]
    if not leads:
        return ()
    best, (frame, count) = base, leads[0].start.values
    tried = {(frame, count)}
    rows = [(leads[0], base.z)]
    for _ in range(ROUNDS):
        fits = clip.crew.each(clip, _fitted, [(base.hypothesis, lead, z) for lead, z in rows])
        found = max(fits, key=lambda fit: fit.evidence, default=best)
        if found.evidence <= best.evidence:
            break
        best = found
        frame, count = best.hypothesis.terms[0].centre
        near = {(frame + a, count + b) for a, b in itertools.product((-1, 0, 1), repeat=2)} - tried
        tried |= near
        rows = [(_at(leads[0], f, c), best.z) for f, c in sorted(near) if 1 <= f < clip.frames and c != 0]
    lead = lead_of(best, base)
    return (Candidate(best, lead, leads[0].gain),) if lead > PROMISED else ()


def _at(lead: Lead, frame: float, count: float) -> Lead:
    return dataclasses.replace(lead, start=dataclasses.replace(lead.start, values=np.array([frame, count])))


def _fitted(clip: ClipFit, plain: Hypothesis, lead: Lead, z: Float[np.ndarray, "dimension"]) -> Fit:
    return knocked(clip, clip.fit(plain.added(lead.term(clip.frames)), z, ITERATIONS, thorough=False))
