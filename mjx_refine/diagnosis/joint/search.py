"""Which effect several clips share: the base model's fit, then every candidate fitted together with it, on the fitted clips."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from mjx_refine.diagnosis.fits.candidates import lead_of
from mjx_refine.diagnosis.fits.fit import SCALE, Fit
from mjx_refine.diagnosis.fits.fitted import Explained
from mjx_refine.diagnosis.joint.fit import Clips, JointFit
from mjx_refine.diagnosis.joint.screen import JointScreen
from mjx_refine.diagnosis.joint.slack import set_slackness, with_slackness
from mjx_refine.diagnosis.search.leads import FORGIVING, chosen_of
from mjx_refine.diagnosis.search.pairs import PROMISE_OF_PAIRS, SECOND_PROMISE
from mjx_refine.diagnosis.search.screen import Lead
from mjx_refine.diagnosis.search.singles import target_name
from mjx_refine.diagnosis.search.tempered import Told
from mjx_refine.effects import catalogue
from mjx_refine.effects.kind import FitView

FAMILIES = 6
"""Families (effect and target) that are fitted in full, the most promising first."""

FRESH = 4
"""Ditto that are fitted from the given scenes as well."""

RIVALS = 3
"""Runners-up that are fitted again from where the best effect's fit ended."""

GOOD = 2.5
"""Mean square residual above which a clip looks for another start by itself."""


@dataclasses.dataclass(frozen=True)
class JointCandidate(Explained):
    """One effect (or several) fitted together with the base parameters.

    Attributes:
      fit: where it ended.
      lead: of its evidence over the base model's, in natural logarithms.
    """

    fit: JointFit
    lead: float


@dataclasses.dataclass(frozen=True)
class JointCompared:
    """All hypotheses about the fitted clips.

    Attributes:
      plain: the base model's fit in which contacts may not err.
      base: the base model's fit.
      candidates: single effects, the best evidence first.
      pairs: two effects, the best evidence first.
      impacts: how many impacts were allowed slack.
      slackness: how much, as a multiple of what a clip alone allows.
    """

    plain: JointFit
    base: JointFit
    candidates: tuple[JointCandidate, ...]
    pairs: tuple[JointCandidate, ...]
    impacts: int
    slackness: float


@dataclasses.dataclass(frozen=True)
class Seen:
    """What the search needs to know of the clips beside their residuals.

    Attributes:
      views: makes what kinds see from a clip's number and its part of a fit.
      names: of the objects.
    """

    views: Callable[[int, Fit], FitView]
    names: tuple[str, ...]


def compare_together(
    clips: Clips, begin: Callable[[], JointFit], seen: Seen, without: Sequence[str], seed: int, told: Told
) -> JointCompared:
    """Fits the base model, then what the linear look promises.

    Args:
      clips: residuals of the fitted clips.
      begin: makes the base model's first fit.
      seen: what kinds look at.
      without: effects that are left out of the catalogue.
      seed: of random hops.
      told: called with a line for each step.
    """
    told("base model")
    plain = base = clips.restarted(begin(), seed, GOOD)
    _allow(clips, base, seed)
    told("how much contacts err")
    base, slackness = with_slackness(clips, base)
    impacts = _allow(clips, base, seed)
    set_slackness(clips, slackness)
    base = clips.restarted(clips.fit(base.hypothesis, base.z, 10), seed, GOOD)
    names = [name for name in catalogue() if name not in without]
    base, singles = _singles(clips, base, seen, names, told)
    pairs = _pairs(clips, base, singles, seen, names, told)
    return JointCompared(plain, base, singles, pairs, impacts, slackness)


def _allow(clips: Clips, base: JointFit, seed: int) -> int:
    """Sets noise, chaos and slack of every clip from the base model's fit; returns how many impacts there are."""
    impacts = 0
    for c, (clip, part) in enumerate(zip(clips.clips, base.parts, strict=True)):
        clip.settle_noise(part)
        hypothesis, z = clips.own(base, c)
        clip.allow_chaos(clip.at(hypothesis, z), seed)
        impacts += clip.allow_slack(part)
    return impacts


def _singles(
    clips: Clips, base: JointFit, seen: Seen, names, told: Told
) -> tuple[JointFit, tuple[JointCandidate, ...]]:
    fitted: dict[tuple[str, int], JointFit] = {}
    for again in range(2):
        told("looking ahead")
        for lead in chosen_of(_look(clips, base, seen, names), FAMILIES if again == 0 else 2):
            told(f"{lead.name} {target_name(seen.names, lead.target)}".strip())
            _fit_lead(clips, base, lead, base.cost, fitted)
        if again == 0:
            # The base model's fit has bent its parameters towards the effect; from the given scenes the way is straight.
            given = clips.at(base.hypothesis, 0 * base.z, scale=FORGIVING)
            for lead in chosen_of(_look(clips, given, seen, names, FORGIVING), FRESH, 1):
                told(f"{lead.name} {target_name(seen.names, lead.target)}, from the given scenes".strip())
                _fit_lead(clips, given, lead, base.cost, fitted)
        best = max(fitted.values(), key=lambda fit: fit.evidence, default=base)
        if not fitted:
            break
        # What an effect's fit found for the base parameters may serve the base model as well.
        other = clips.fit(base.hypothesis, best.hypothesis.without_terms(best.z), 8)
        if other.cost > base.cost - 1.0:
            break
        base = other
    _not_below(clips, base, fitted)
    _from_the_best(clips, base, fitted)
    found = [JointCandidate(fit, lead_of(fit, base)) for fit in fitted.values()]
    return base, tuple(sorted(found, key=lambda c: -c.lead))


def _look(clips: Clips, fit: JointFit, seen: Seen, names, scale: float = SCALE) -> list[Lead]:
    views = [seen.views(c, part) for c, part in enumerate(fit.parts)]
    return JointScreen(clips, fit, views, scale).leads(names)


def _fit_lead(clips: Clips, here: JointFit, lead: Lead, rival: float, fitted: dict) -> None:
    """Fits a lead from where it was seen, and keeps it where it is the family's best; ``rival``: what the base model costs."""
    one = lead.term(clips.frames)
    hypothesis = here.hypothesis.added(one)
    z = _begin(clips, hypothesis, here, lead, lead.z(one))
    given = not here.z.any()
    if given:
        z = clips.fit(hypothesis, z, 7, scale=FORGIVING).z
    fit = clips.fit(hypothesis, z, 9, rival=rival)
    if fit.cost > here.cost and not given:
        # Where the linear look misleads, the effect grows from nothing.
        fit = clips.fit(hypothesis, hypothesis.grown(here.z, 0 * lead.z(one)), 9, rival=rival)
    key = (lead.name, lead.target)
    if key not in fitted or fit.evidence > fitted[key].evidence:
        fitted[key] = fit


def _begin(clips: Clips, hypothesis, here: JointFit, lead: Lead, z: np.ndarray) -> np.ndarray:
    """Where the fit starts: a part of the way that the linear look points, base parameters and effect together."""
    parts = (0.0, 0.1, 0.3, 0.6, 1.0) if lead.start.columns else (0.0, 0.3, 1.0)
    limited = np.clip(lead.shift, -10.0, 10.0)
    return clips.best_of(hypothesis, np.array([hypothesis.grown(here.z + a * limited, a * z) for a in parts]))


def _not_below(clips: Clips, base: JointFit, fitted: dict[tuple[str, int], JointFit]) -> None:
    """Effects whose fit is worse than the base model's, which they hold, once more from there."""
    for key, fit in list(fitted.items()):
        if fit.cost < base.cost:
            continue
        count = int(fit.hypothesis.terms[-1].free.sum())
        last = fit.z[fit.hypothesis.count - count : fit.hypothesis.count]
        points = np.array([fit.hypothesis.grown(base.z, part * last) for part in (0.0, 0.1, 0.3, 1.0)])
        again = clips.fit(fit.hypothesis, clips.best_of(fit.hypothesis, points), 7)
        if again.evidence > fit.evidence:
            fitted[key] = again


def _from_the_best(clips: Clips, base: JointFit, fitted: dict[tuple[str, int], JointFit]) -> None:
    """Runners-up once more from the base parameters that the best effect's fit found: one basin is fair to all."""
    ordered = sorted(fitted, key=lambda key: -fitted[key].evidence)
    best = fitted[ordered[0]] if ordered else base
    ground = best.hypothesis.without_terms(best.z)
    for key in ordered[1 : 1 + RIVALS]:
        fit = fitted[key]
        if fit.evidence < base.evidence + 0.1 * (best.evidence - base.evidence):
            break
        z = fit.z.copy()
        z[fit.hypothesis.ordinary] = ground
        again = clips.fit(fit.hypothesis, z, 8)
        if again.evidence > fit.evidence:
            fitted[key] = again


def _pairs(clips: Clips, base: JointFit, singles, seen: Seen, names, told: Told) -> tuple[JointCandidate, ...]:
    """Forward selection of a second effect beside the best one."""
    found: list[JointCandidate] = []
    for first in singles[:1]:
        if first.lead < PROMISE_OF_PAIRS:
            break
        here = first.fit
        allowed = [n for n in names if n not in first.names or catalogue()[n].targeted]
        leads = [lead for lead in _look(clips, here, seen, allowed) if (lead.name, lead.target) != first.effects[0]]
        for lead in [x for x in chosen_of(leads, 2, 1) if x.gain > SECOND_PROMISE]:
            told(f"{first.names[0]} and {lead.name}")
            one = lead.term(clips.frames)
            hypothesis = here.hypothesis.added(one)
            fit = clips.fit(hypothesis, _begin(clips, hypothesis, here, lead, lead.z(one)), 7)
            found.append(JointCandidate(fit, lead_of(fit, base)))
    return tuple(sorted(found, key=lambda c: -c.lead))
