"""The answer that all hypotheses of one clip give, and what it is read from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from mjx_refine.diagnosis.answer.verdict import NAMED, Answer, answer, upheld
from mjx_refine.diagnosis.fits.candidates import Candidate, Compared, unit_of
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.misfit.heldout import HeldOut, held_out
from mjx_refine.diagnosis.misfit.signs import MOSTLY, Signs, best_candidate, signs
from mjx_refine.diagnosis.search.tempered import Shown, Told
from mjx_refine.diagnosis.search.unnamed import freely_forced


@dataclasses.dataclass(frozen=True)
class Judged:
    """An answer.

    Attributes:
      compared: the hypotheses, with a force of any course where that was asked for.
      best: of singles and pairs; None where nothing leads the base model.
      outside_of: what the base model and a fit leave on frames that no fit has seen; of the base model alone, of None.
      signs: what the answer was read from.
      said: the answer.
    """

    compared: Compared
    best: Candidate | None
    outside_of: Callable[[Fit | None], HeldOut]
    signs: Signs
    said: Answer


def judged(clip: ClipFit, compared: Compared, shown: Shown, told: Told) -> Judged:
    """The answer of one video.

    Args:
      clip: residuals, as they were when the hypotheses were fitted.
      compared: the hypotheses.
      shown: what a fit shows, of what is seen.
      told: called with a line for each step.
    """
    told("held-out frames")
    kept: dict[int, HeldOut] = {}

    def outside_of(fit: Fit | None) -> HeldOut:
        if id(fit) not in kept:
            kept[id(fit)] = held_out(clip, compared.base, fit)
        return kept[id(fit)]

    best = best_candidate(compared)
    outside = outside_of(best.fit if best else None)
    seen = shown(compared.base)
    aloft = (seen.on_floor.mean(0) < MOSTLY).any()
    if aloft or (best is not None and best.lead > NAMED * unit_of(clip, best.fit)):
        told("a force without a name")
        freed = freely_forced(clip, compared, best.fit if best else compared.base, seen, shown)
        compared = dataclasses.replace(compared, freed=freed)
    found = signs(clip, compared, outside.gain, outside.closed_of_all)
    leads = [c.lead for c in compared.candidates]
    said = upheld(
        answer(found, leads, video=True), compared, found, lambda fit: outside_of(fit).closed_of_all, video=True
    )
    return Judged(compared, best, outside_of, found, said)
