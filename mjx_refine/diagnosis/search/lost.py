"""Frames that are missing or doubled: before states after impacts would take them in, and with another frame or count than was
fitted."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.candidates import Candidate, lead_of
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, Term
from mjx_refine.diagnosis.fits.knock import knocked
from mjx_refine.diagnosis.search.screen import Screen
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
    begun = _fitted(clip, base.hypothesis.added(leads[0].term(clip.frames)), base.z)
    best = recounted(clip, begun) if begun.evidence > base.evidence else base
    lead = lead_of(best, base)
    return (Candidate(best, lead, leads[0].gain),) if lead > PROMISED else ()


def recounted(clip: ClipFit, best: Fit) -> Fit:
    """A fit with frames that are missing or doubled alone, or a better one with another frame or count beside its own.

    Ordinary numbers bend to what a wrong count leaves, and the linear look from there tells that wrong count.
    """
    tried = {tuple(best.hypothesis.terms[0].centre)}
    for _ in range(ROUNDS):
        (lost,) = best.hypothesis.terms
        frame, count = lost.centre
        near = {(frame + a, count + b) for a, b in itertools.product((-1, 0, 1), repeat=2)} - tried
        tried |= near
        beside = [np.array(place) for place in sorted(near) if 1 <= place[0] < clip.frames and place[1] != 0]
        rows = [(_with(best.hypothesis, dataclasses.replace(lost, centre=place)), best.z) for place in beside]
        found = max(clip.crew.each(clip, _fitted, rows), key=lambda fit: fit.evidence, default=best)
        if found.evidence <= best.evidence:
            break
        best = found
    return best


def _with(hypothesis: Hypothesis, term: Term) -> Hypothesis:
    return dataclasses.replace(hypothesis, terms=(term,))


def _fitted(clip: ClipFit, hypothesis: Hypothesis, z: Float[np.ndarray, "dimension"]) -> Fit:
    return knocked(clip, clip.fit(hypothesis, z, ITERATIONS, thorough=False))
