"""Effects that act all along, fitted by stages from the given scene with more noise than there is.

Such an effect shows from the first frames on, before anything has been hit, so over ever more of a clip its numbers and the
ordinary ones are found together. Fits that begin from the base model's, or from a linear look at it, begin where ordinary numbers
have bent to imitate it; and states of their own after impacts may take in what it does, one flight after another.
"""

from __future__ import annotations

import dataclasses

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.search.exchange import Key
from mjx_refine.diagnosis.search.screen import families_of, term_of
from mjx_refine.diagnosis.search.tempered import COOLER, Told, from_given, tempered, to_the_noise
from mjx_refine.effects import catalogue
from mjx_refine.effects.kind import FitView

END = 3
"""Effects and targets that go on with the noise as it is, the cheapest first. (031 of seed 36 of the withheld exams, two objects
that bounce in a wind: with ten times the noise it costs 32 and the base model 34, with three times the noise 114 and 134, and in
the end it leads by 179.)"""


def unhurried(
    clip: ClipFit, base: Fit, names: list[str], view: FitView, told: Told
) -> tuple[Fit, list[tuple[Key, Fit]]]:
    """The base model's fit, and those of the most promising effects that act all along, by name and target.

    Args:
      clip: residuals.
      base: the base model's fit, whose hypothesis is begun from the given scene, too, lest an effect lead that has only found
        better ordinary numbers.
      names: of the catalogue.
      view: what kinds need to know.
      told: called with a line when it begins.
    """
    told("from the given scene, by stages")
    plain = dataclasses.replace(base.hypothesis, slack=None)
    keys = families_of([name for name in names if catalogue()[name].steady], view)
    hypotheses = [
        plain,
        *(plain.added(term_of(*key, catalogue()[key[0]].still(view, key[1]), clip.frames)) for key in keys),
    ]
    with tempered(clip, COOLER):
        ground, *fits = clip.crew.each(clip, from_given, [(one, True) for one in hypotheses])
    found = sorted(zip(keys, fits, strict=True), key=lambda one: one[1].cost)[:END]
    ground, *fits = clip.crew.each(clip, to_the_noise, [(ground,), *((fit,) for _, fit in found)])
    best = max(base, ground, key=lambda fit: fit.evidence)
    return best, [(key, fit) for (key, _), fit in zip(found, fits, strict=True)]
