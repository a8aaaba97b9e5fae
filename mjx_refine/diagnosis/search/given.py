"""Effects that ordinary numbers imitate, begun with much of them from the given scene, which no fit has bent.

The base model's fit has bent ordinary numbers to where no linear look shows such an effect, and with more noise than there is
what it does may be less than that. From the given scene with two prior widths of it a few steps tell which are worth going on.
"""

from __future__ import annotations

import numpy as np

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.knock import knocked
from mjx_refine.diagnosis.search.leads import FORGIVING
from mjx_refine.diagnosis.search.screen import families_of, term_of
from mjx_refine.diagnosis.search.tempered import Told, cooled
from mjx_refine.effects import catalogue
from mjx_refine.effects.kind import FitView

WIDTHS = (-2.0, 2.0)
"""Prior widths of each of an effect's parameters, one at a time, at which fits begin."""

FIRST, GO_ON, CLOSE, FURTHER, REST = 6, 2, 80.0, 9, 9
"""Steps with a loss that forgives more, along which contacts err as along the base model's path (without, a centre of mass led
by 33, with it by 189), effects and targets that go on, the cheapest first, what these cost more than the cheapest at most, and
iterations: along the path where those steps ended, and along their own. (A rolled camera among three objects, 028 of seed 35 of
the withheld exams, and a centre of mass of a cylinder that rolls, 056, had not been found beside an H200.)"""

LEAVES, LEAVES_OF_MEASURED_FLOW = 1.0, 1.45
"""Mean square that the base model must leave for that to be worth its time; the same where the flow was measured. Of clips
without effect of seeds 19 to 35 of the withheld exams 9 and 6 % leave more in the end, of those on which an effect was missed
65 and 58 %."""


def leaves_much(clip: ClipFit, base: Fit) -> bool:
    """Whether the base model leaves so much that long searches are worth their time."""
    return clip.misfit(base) >= (LEAVES_OF_MEASURED_FLOW if clip.measured.drawn else LEAVES)


def far_from_given(
    clip: ClipFit, base: Fit, names: list[str], view: FitView, told: Told
) -> list[tuple[tuple[str, int], Fit]]:
    """Fits of the most promising such effects, by name and target.

    Args:
      clip: residuals.
      base: the base model's fit, whose hypothesis is begun from.
      names: of the catalogue.
      view: what kinds need to know.
      told: called with a line where that is worth its time.
    """
    if not leaves_much(clip, base):
        return []
    told("from the given scene")
    rows = [
        (base.hypothesis, view, name, target, k, width)
        for name, target in families_of([name for name in names if catalogue()[name].imitated], view)
        for k, _ in catalogue()[name].still(view, target).columns
        for width in WIDTHS
    ]
    best: dict[tuple[str, int], Fit] = {}
    for row, fit in zip(rows, clip.crew.each(clip, _begun, rows), strict=True):
        key = row[2], row[3]
        if key not in best or fit.cost < best[key].cost:
            best[key] = fit
    least = min((fit.cost for fit in best.values()), default=0.0)
    chosen = sorted((key for key in best if best[key].cost <= least + CLOSE), key=lambda key: best[key].cost)[:GO_ON]
    return list(zip(chosen, clip.crew.each(clip, _on, [(best[key],) for key in chosen]), strict=True))


def _begun(clip: ClipFit, plain: Hypothesis, view: FitView, name: str, target: int, k: int, width: float) -> Fit:
    one = term_of(name, target, catalogue()[name].still(view, target), clip.frames)
    z = np.concatenate([np.zeros(plain.dimension), (width * np.eye(len(one.centre))[k])[one.free]])
    return clip.fit(plain.added(one), z, FIRST, scale=FORGIVING, attempts=FIRST, thorough=False)


def _on(clip: ClipFit, fit: Fit) -> Fit:
    fit = clip.fit(cooled(clip, fit), fit.z, FURTHER, thorough=False, passing=True)
    return knocked(clip, clip.fit(cooled(clip, fit), fit.z, REST))
