"""What the catalogue does not hold: a force of any course, fitted beside the effects that have names.

Of a drag that has been left out of the catalogue a push explains much, and what it leaves is little more than noise. A force that
may change as it likes explains more than that push, by more than its numbers cost in evidence; of a push it explains less.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from mjx_refine.diagnosis.fits.candidates import Compared, Freed
from mjx_refine.diagnosis.fits.fit import SCALE, ClipFit, Fit
from mjx_refine.diagnosis.fits.knock import knocked
from mjx_refine.diagnosis.search.exchange import NEAR, SOURCES, begun_again
from mjx_refine.diagnosis.search.leads import FORGIVING, begun
from mjx_refine.diagnosis.search.screen import Lead, Screen
from mjx_refine.effects.free_force import FreeForce
from mjx_refine.effects.kind import FitView

ITERATIONS = 14
"""Of least squares."""


def freely_forced(
    clip: ClipFit, compared: Compared, best: Fit, seen: FitView, shown: Callable[[Fit], FitView]
) -> Freed:
    """The force without a name that explains a clip best.

    Args:
      clip: residuals.
      compared: the hypotheses with names.
      best: of them, or the base model's: where its base parameters are the force begins as well.
      seen: what the base model's rollout shows.
      shown: what a fit's does.
    """
    base = compared.base
    looks = [(base, seen, SCALE)]
    if best is not base:
        ground = dataclasses.replace(base.hypothesis, slack=best.hypothesis.slack)
        bare = clip.at(ground, best.z[: base.hypothesis.dimension], scale=FORGIVING)
        looks.append((bare, shown(bare), FORGIVING))
    leads = clip.crew.each(clip, _best_lead, looks)
    others = [base, *(one.fit for one in (*compared.candidates[:SOURCES], *compared.pairs[:1]))]
    rows = [(here, lead, scale, best.cost, others) for (here, _, scale), lead in zip(looks, leads, strict=True)]
    fits = clip.crew.each(clip, _fitted, rows)
    fit = max(fits, key=lambda one: one.evidence)
    target = fit.hypothesis.terms[-1].target
    return Freed(fit, float(seen.on_floor[:, target].mean()))


def _best_lead(clip: ClipFit, here: Fit, view: FitView, scale: float) -> Lead:
    """Of all objects."""
    kind, look = FreeForce(), Screen(clip, here, view, scale)
    leads = [look.looked(kind, target, kind.starts(view, target))[0] for target in range(len(view.batch.shapes))]
    return max(leads, key=lambda lead: lead.gain)


def _fitted(clip: ClipFit, here: Fit, lead: Lead, scale: float, rival: float, others: list[Fit]) -> Fit:
    hypothesis, z = begun(clip, here, lead, scale)
    fit = knocked(clip, clip.fit(hypothesis, z, ITERATIONS, rival=rival, thorough=False), rival)
    return begun_again(clip, fit, others, here.hypothesis.dimension) if fit.cost < NEAR * rival else fit
