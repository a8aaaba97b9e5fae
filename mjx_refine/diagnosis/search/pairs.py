"""Two effects at once: a second beside the best, and the best together."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.candidates import Candidate, in_order, lead_of, obstacle_for, rivals, unit_of
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.knock import knocked
from mjx_refine.diagnosis.fits.roam import ROAMED_AGAIN
from mjx_refine.diagnosis.misfit.signs import STILL, structure, unsteadiness
from mjx_refine.diagnosis.search.leads import beginning, chosen_of
from mjx_refine.diagnosis.search.patches import patches_from_pushes
from mjx_refine.diagnosis.search.screen import Lead, Screen
from mjx_refine.diagnosis.search.tempered import Shown, Told, beside_tempered, cooled
from mjx_refine.diagnosis.search.walls import push_last, walls_from_pushes
from mjx_refine.effects import catalogue

SECOND_PROMISE = 8.0
"""Evidence that the linear look must promise for a second effect to be fitted beside the first."""

PROMISE_OF_PAIRS, FIRSTS, SECONDS = 15.0, 2, 5
"""Lead that an effect needs for a second one to be looked for beside it, beside how many causes that is done, and how many second
effects are looked at beside each."""

HOPE = 30.0
"""What a second effect must promise beside the best, in units of the misfit left, for two to be looked for where none of those
that were found with more noise leads it. In 19 clips with effects of seeds 28 to 30 of the withheld exams the best second one
promised (evidence, not in such units) 172 at least where two were named, 8 to 67 where two act and were not, and 22 at most where
one acts."""

CLEAN, ROUGH = 1.0, 0.7
"""Mean square residual of the best effect, and how smooth in time it is (``signs.structure``), below both of which no second
effect is looked for where the background is still, since noise is all that is left. Of 124 clips of seeds 12 to 34 of the
withheld exams in which two were named rightly the best one's residual by itself was less smooth than that in 11, in most of
which the camera moves; so it was in 378 of 751 in which one was named."""

JOINED, LOOK, TOGETHER = 4, 4, 6
"""Of how many of the best effects twos are put together, after how many steps their fits are compared, how many of these go on:
what each found alone is a better place to begin than a linear look from a fit that has bent to the other effect."""

COOLED = 5
"""How many twos that were fitted with more noise go on with the noise as it is."""

PARTS = ((1.0, 1.0), (0.5, 0.5), (1.0, 0.3), (0.3, 1.0), (0.7, 0.7))
"""How much of each of two effects their common fit begins with: alone, each explains part of what is the other's."""

ITERATIONS, FINALISTS, MORE_ITERATIONS = 7, 3, 10
"""Of least squares of two effects; how many of the best twos go on from there, and for how many more."""

ROAMING = 2
"""How many of the best twos look beyond where least squares ended: they end a few tens of evidence apart by chance."""

WALLS = 2
"""How many of the best twos with a push are looked at with an obstacle, or a patch of the floor, in its place."""


def pairs_of(
    clip: ClipFit,
    base: Fit,
    singles: tuple[Candidate, ...],
    early: tuple[Candidate, ...],
    names: list[str],
    shown: Shown,
    seed: int,
    told: Told,
) -> tuple[Candidate, ...]:
    """Two effects at once, the best evidence first; none where no effect by itself leads enough.

    Args:
      clip: residuals.
      base: the base model's fit.
      singles: every effect by itself, the best evidence first.
      early: two effects that were found before.
      names: of the catalogue.
      shown: what a fit shows to those who look for a start.
      seed: of random hops.
      told: called with a line for each step.
    """
    firsts = _firsts(singles)
    ahead = any(two.lead > singles[0].lead for two in early)
    if not ahead and firsts and _only_noise(clip, firsts[0].fit):
        return in_order(clip, early)
    beside = list(_beside(clip, firsts[:1], names, shown))
    unit = unit_of(clip, firsts[0].fit) if firsts else 1.0
    if not ahead and not any(lead.gain > HOPE * unit for _, lead in beside):
        return in_order(clip, early)
    beside += _beside(clip, firsts[1:], names, shown)
    lines = [f"{first.names[0]} and {lead.name}" for first, lead in beside]
    looks = clip.crew.each(clip, _second, [(first.fit, lead) for first, lead in beside], told, lines)
    fits = _best_joined(clip, looks, [first.fit.cost for first, _ in beside])
    found = [Candidate(fit, lead_of(fit, base), beside[k][1].gain) for k, fit in fits]
    found += early
    together = list(_together(clip, base, singles)) if beside else []
    lines = [f"{first.names[0]} and {second.names[0]}, together" for _, _, first, second in together]
    rows = [(hypothesis, z, min(first.fit.cost, second.fit.cost)) for hypothesis, z, first, second in together]
    looks = clip.crew.each(clip, _looked, rows, told, lines)
    fits = _best_joined(clip, looks, [rival for _, _, rival in rows])
    found += [Candidate(fit, lead_of(fit, base), 0.0) for _, fit in fits]
    found = _gone_on(clip, base, found)
    found += list(_in_place_of_pushes(clip, base, singles, found, names, shown, told))
    found.sort(key=lambda one: -one.lead)
    best = [one for one in _differing(found)[:ROAMING] if one.lead > singles[0].lead]
    fits = clip.crew.each(clip, _roamed, [(one.fit, seed) for one in best])
    found = [one for one in found if not any(one is other for other in best)]
    found += [dataclasses.replace(one, fit=fit, lead=lead_of(fit, base)) for one, fit in zip(best, fits, strict=True)]
    return in_order(clip, found)


def _only_noise(clip: ClipFit, fit: Fit) -> bool:
    """Whether a fit leaves nothing that a second effect could explain."""
    return clip.misfit(fit) < CLEAN and structure(clip, fit) < ROUGH and unsteadiness(clip, fit) < STILL


def _differing(found: list[Candidate]) -> list[Candidate]:
    """The best of each two effects, in their order."""
    kept: dict[tuple, Candidate] = {}
    for one in found:
        kept.setdefault(tuple(sorted(one.effects)), one)
    return list(kept.values())


def _roamed(clip: ClipFit, fit: Fit, seed: int) -> Fit:
    other = clip.roam(fit, seed, ROAMED_AGAIN)
    return other if other.evidence > fit.evidence else fit


def _gone_on(clip: ClipFit, base: Fit, found: list[Candidate]) -> list[Candidate]:
    """The twos in their order, the best of them at the end of their least squares."""
    found = sorted(found, key=lambda one: -one.lead)
    fits = clip.crew.each(clip, _further, [(one.fit,) for one in found[:FINALISTS]])
    best = [dataclasses.replace(one, fit=fit, lead=lead_of(fit, base)) for one, fit in zip(found, fits, strict=False)]
    return sorted([*best, *found[FINALISTS:]], key=lambda one: -one.lead)


def _further(clip: ClipFit, fit: Fit) -> Fit:
    further = clip.fit(fit.hypothesis, fit.z, MORE_ITERATIONS)
    return further if further.evidence > fit.evidence else fit


def _beside(clip: ClipFit, firsts: list[Candidate], names: list[str], shown: Shown) -> Iterator[tuple[Candidate, Lead]]:
    """Forward selection: what the linear look promises beside the best effects."""
    for first in firsts:
        others = _others(first.fit, names)
        leads = Screen(clip, first.fit, shown(first.fit)).leads(others)
        leads = [x for x in leads if (x.name, x.target) not in first.effects]
        # So many effects, not so many moments of one push.
        yield from ((first, x) for x in chosen_of(leads, SECONDS, 1) if x.gain > SECOND_PROMISE)


def _firsts(singles: tuple[Candidate, ...]) -> list[Candidate]:
    """Beside which second effects are looked for."""
    firsts: list[Candidate] = []
    for one in itertools.takewhile(lambda one: one.lead >= PROMISE_OF_PAIRS, rivals(singles)):
        if len(firsts) < FIRSTS and not any(_one_cause(one, other) for other in firsts):
            firsts.append(one)
    return firsts


def _others(first: Fit, names: list[str]) -> list[str]:
    """Effects that are looked for beside one."""
    return [n for n in names if catalogue()[n].targeted or n not in {t.name for t in first.hypothesis.terms}]


def annealed_pairs(
    clip: ClipFit,
    base: Fit,
    singles: tuple[Candidate, ...],
    unbent: list[Fit],
    names: list[str],
    shown: Shown,
    told: Told,
) -> tuple[Candidate, ...]:
    """Two effects at once, the best evidence first, of which the second was found beside the first with more noise than there
    is: there the first has not bent towards the second.

    Args:
      clip: residuals.
      base: the base model's fit.
      singles: every effect by itself, the best evidence first.
      unbent: fits of some effects by themselves with more noise, the best first.
      names: of the catalogue.
      shown: what a fit shows to those who look for a start.
      told: called with a line for each step.
    """
    straight = _differing([Candidate(fit, 0.0, 0.0) for fit in unbent])[:FIRSTS]
    firsts = [one for one in _firsts(singles) if not any(_one_cause(one, other) for other in straight)]
    grounds = ([one.fit for one in firsts], [one.fit for one in straight])
    found = beside_tempered(clip, *grounds, lambda fit: _others(fit, names), shown, told, SECONDS)
    rival = singles[0].fit.cost
    fits = clip.crew.each(clip, _cooled, [(fit, rival) for _, fit in found[:COOLED]])
    twos = [Candidate(fit, lead_of(fit, base), lead.gain) for (lead, _), fit in zip(found, fits, strict=False)]
    return in_order(clip, _differing(sorted(twos, key=lambda one: -one.lead)))


def _cooled(clip: ClipFit, fit: Fit, rival: float) -> Fit:
    return _joined(clip, cooled(clip, fit), fit.z, rival)


def _one_cause(one: Candidate, other: Candidate) -> bool:
    """Whether two effects are the same, or a push and an obstacle in its place."""
    same = (one.names, one.targets) == (other.names, other.targets)
    return same or obstacle_for(one, other) or obstacle_for(other, one)


def _together(
    clip: ClipFit, base: Fit, singles: tuple[Candidate, ...]
) -> Iterator[tuple[Hypothesis, Float[np.ndarray, "dimension"], Candidate, Candidate]]:
    """Twos of the best effects, each as it was found alone, and where their fits begin; with the best one, or of its rivals."""
    with_best = ((singles[0], other) for other in singles[1:JOINED])
    for one, other in itertools.chain(with_best, itertools.combinations(rivals(singles)[1:JOINED], 2)):
        if other.lead > 0 and not _one_cause(one, other):
            yield from _starts_of_two(clip, base, one, other)


def _starts_of_two(
    clip: ClipFit, base: Fit, one: Candidate, other: Candidate
) -> Iterator[tuple[Hypothesis, Float[np.ndarray, "dimension"], Candidate, Candidate]]:
    """Where the fits of two effects begin: not only where it costs least, since from the better one's ordinary numbers fits end
    well that begin badly."""
    count, hypothesis = base.hypothesis.dimension, one.fit.hypothesis.added(other.fit.hypothesis.terms[-1])
    first, second = one.fit.z, other.fit.z
    parts = [(a * first[count:], b * second[count:]) for a, b in PARTS]
    for grounds in ([first[:count]], [second[:count], first[:count] + second[:count] - base.z]):
        points = np.array([np.concatenate([z, *two]) for z in grounds for two in parts])
        yield hypothesis, clip.best_of(hypothesis, points), one, other


def _in_place_of_pushes(
    clip: ClipFit,
    base: Fit,
    singles: tuple[Candidate, ...],
    found: list[Candidate],
    names: list[str],
    shown: Shown,
    told: Told,
) -> Iterator[Candidate]:
    """The best twos with a push once more with an obstacle, and with a patch of the floor, in its place."""
    pushed = [one for one in found if "push" in one.names and one.lead > singles[0].lead][:WALLS]
    ends = [(push_last(one.fit), shown(one.fit)) for one in pushed]
    others = [_other(one, "push") for one in pushed]
    fits: list[Fit | None] = []
    if "hidden_obstacle" in names:
        rows = [(*end, _without_push(base, singles, one)) for end, one in zip(ends, pushed, strict=True)]
        fits += walls_from_pushes(clip, rows, told, [f"{other} and hidden_obstacle" for other in others])
    if "friction_patch" in names:
        floors = [(end, other) for end, other in zip(ends, others, strict=True) if other != "friction_patch"]
        for _, other in floors:
            told(f"{other} and friction_patch")
        fits += patches_from_pushes(clip, [end for end, _ in floors])
    yield from (Candidate(fit, lead_of(fit, base), 0.0) for fit in fits if fit is not None)


def _without_push(base: Fit, singles: tuple[Candidate, ...], one: Candidate) -> float:
    """What the other of two effects costs alone, or the base model where it was not fitted alone."""
    rest = one.effects[1 - one.names.index("push")]
    return next((c.fit.cost for c in singles if c.effects[0] == rest), base.cost)


def _other(one: Candidate, name: str) -> str:
    """The effect of two beside one of this name."""
    return one.names[0] if one.names[1] == name else one.names[1]


def _second(clip: ClipFit, first: Fit, lead: Lead) -> Fit:
    """The fit with one more effect, after its first steps."""
    one = lead.term(clip.frames)
    hypothesis = first.hypothesis.added(one)
    return _looked(clip, hypothesis, beginning(clip, hypothesis, first, lead, lead.z(one)), first.cost)


def _looked(clip: ClipFit, hypothesis: Hypothesis, z: Float[np.ndarray, "dimension"], rival: float) -> Fit:
    return clip.fit(hypothesis, z, ITERATIONS, rival=rival, attempts=LOOK, thorough=False)


def _best_joined(clip: ClipFit, looks: list[Fit], rivals: list[float]) -> list[tuple[int, Fit]]:
    """The best of some fits after their first steps: their places, and the fits once they have gone on."""
    near = sorted(range(len(looks)), key=lambda k: looks[k].cost)[:TOGETHER]
    rows = [(looks[k].hypothesis, looks[k].z, rivals[k]) for k in near]
    return list(zip(near, clip.crew.each(clip, _joined, rows), strict=True))


def _joined(clip: ClipFit, hypothesis: Hypothesis, z: Float[np.ndarray, "dimension"], rival: float) -> Fit:
    """The fit of two effects; ``rival``: what one of them alone costs."""
    return knocked(clip, clip.fit(hypothesis, z, ITERATIONS, rival=rival, thorough=False), rival)
