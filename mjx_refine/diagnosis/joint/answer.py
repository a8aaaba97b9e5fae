"""From several clips' fits, and what they foretell of held-out ones, to an answer."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from mjx_refine.diagnosis.answer.verdict import AT_WORK, LIKELY, LITTLE, NAMED, Answer, answer
from mjx_refine.diagnosis.diagnose import verdict_of
from mjx_refine.diagnosis.fits.numbers import values_of
from mjx_refine.diagnosis.joint.fit import Clips, JointFit
from mjx_refine.diagnosis.joint.heldout import Outside
from mjx_refine.diagnosis.joint.search import JointCandidate, JointCompared
from mjx_refine.diagnosis.misfit.signs import Signs, structure
from mjx_refine.diagnosis.result import Ranked, Value, Verdict

JUDGED = 3
"""Single effects that are judged on held-out clips, the best evidence first."""


@dataclasses.dataclass(frozen=True)
class Said:
    """The answer and what it rests on.

    Attributes:
      verdict: the answer.
      answer: its kind and probability.
      signs: what it was read from.
      best: the candidate behind it, or None.
      shown: what the gap is measured with: ``best``, or else the best candidate, or None.
      refuted: candidates that lead on the fitted clips and foretell nothing of the others.
    """

    verdict: Verdict
    answer: Answer
    signs: Signs
    best: JointCandidate | None
    shown: JointCandidate | None
    refuted: tuple[JointCandidate, ...]


def to_judge(compared: JointCompared) -> list[JointCandidate]:
    """Candidates whose say on held-out clips matters."""
    singles = [c for c in compared.candidates[:JUDGED] if c.lead > LITTLE] or list(compared.candidates[:1])
    return singles + [c for c in compared.pairs[:1] if singles and c.lead > singles[0].lead]


def said(
    clips: Clips, compared: JointCompared, outside: list[tuple[JointCandidate, Outside]], least: float, seed: int
) -> Said:
    """The answer.

    Args:
      clips: the fitted ones.
      compared: their hypotheses.
      outside: candidates that were judged, with what they foretold.
      least: misfit below which leads are not counted in units of it.
      seed: of the bootstrap.
    """
    refuted = tuple(c for c, told in outside if not told.sure(seed) or no_better_than_one(c, told, outside))
    tested = {id(c) for c, _ in outside}

    def standing(candidates) -> tuple[JointCandidate, ...]:
        return tuple(c for c in candidates if id(c) in tested and not any(c is r for r in refuted))

    kept = dataclasses.replace(compared, candidates=standing(compared.candidates), pairs=standing(compared.pairs))
    held_out = max((float(told.gains.sum()) for _, told in outside), default=0.0)
    closed = {id(c): told.closed for c, told in outside}
    found = joint_signs(clips, kept, held_out, least, lambda one: closed[id(one)])
    told = answer(found, [c.lead for c in kept.candidates])
    if told.kind == "none" and outside[0][1].inexplicable:
        # What the fit excuses, by bending the starts, does not foretell the other clips.
        told = Answer("unknown", LIKELY, told.shares, AT_WORK["unknown"])
    names, shapes = compared.base.hypothesis.space.scene.names, compared.base.hypothesis.space.scene.shapes
    verdict, best = verdict_of(kept, told, names, shapes)  # type: ignore[arg-type]
    sentence = verdict.sentence.replace("This clip cannot", "These clips cannot").replace("the clip to", "the clips to")
    verdict = dataclasses.replace(verdict, sentence=sentence)
    shown = best or (outside[0][0] if outside else None)  # type: ignore[assignment]
    return Said(verdict, told, found, best, shown, refuted)  # type: ignore[arg-type]


def no_better_than_one(candidate: JointCandidate, told: Outside, outside: list[tuple[JointCandidate, Outside]]) -> bool:
    """Whether one of two effects foretells the others as well by itself: then the second only bends with the fitted clips."""
    if len(candidate.names) < 2:
        return False
    alone = [other.gains.sum() for c, other in outside if len(c.names) == 1 and c.names[0] in candidate.names]
    return bool(told.gains.sum() <= max(alone, default=-np.inf))


def joint_signs(
    clips: Clips,
    compared: JointCompared,
    held_out: float,
    least: float,
    closed_of: Callable[[JointCandidate], float],
) -> Signs:
    """As ``signs.signs``, over all fitted clips: structure is their mean, and what is closed is of the others."""
    singles, pairs, base = compared.candidates, compared.pairs, compared.base
    ends = [base, *(c.fit for c in (*singles[:3], *pairs[:1]))]
    unit = max(min(clips.misfit(fit) for fit in ends), least)
    first = singles[0] if singles else None
    other = next((c for c in singles if first is not None and c.names != first.names), None)
    leading = [c for c in (*singles[:1], *pairs[:1]) if c.lead > 0]
    best = max(leading, key=lambda c: c.lead) if leading else None
    after = best.fit if best else base
    lead = first.lead / unit if first else 0.0
    return Signs(
        lead=lead,
        margin=(first.lead - max(other.lead, 0.0) if other else first.lead) / unit if first else 0.0,
        pair=(pairs[0].lead - first.lead) / unit if pairs and first else 0.0,
        before=clips.misfit(base),
        after=clips.misfit(after),
        structure_before=_structure(clips, base),
        structure_after=_structure(clips, after),
        held_out=held_out / unit,
        whole=1.0 if lead >= NAMED / 2 else 2 * base.data / clips.expected(),
        closed=closed_of(best) if best else 1.0,
    )


def _structure(clips: Clips, fit: JointFit) -> float:
    return float(np.mean([structure(clip, part) for clip, part in zip(clips.clips, fit.parts, strict=True)]))


def ranked(
    clips: Clips, compared: JointCompared, told: Said, outside: list[tuple[JointCandidate, Outside]]
) -> tuple[Ranked, ...]:
    """Every fitted effect, the likeliest first; of two at work, both with the parameters of their common fit."""
    scene = compared.base.hypothesis.space.scene
    judged = {id(c): o for c, o in outside}
    standing = [c for c in compared.candidates if id(c) in judged and not any(c is r for r in told.refuted)]
    shares = dict(zip(map(id, standing), told.answer.shares, strict=False))

    def row(candidate: JointCandidate, k: int, probability: float) -> Ranked:
        t = candidate.fit.hypothesis.terms[k]
        target = scene.names[t.target] if t.target >= 0 else None
        sentence = t.kind.sentence.format(target=target or "", shape=scene.shapes[t.target] if t.target >= 0 else "")
        found = judged.get(id(candidate))
        after, closed = (found.numbers[1], found.closed) if found else (math.nan, math.nan)
        values = _values(clips, candidate.fit, k)
        return Ranked(t.name, target, probability, candidate.lead, values, after, closed, sentence)

    single = standing[0].names[0] if standing else ""
    pair = told.best if told.best is not None and len(told.best.names) > 1 else None
    rows = [row(pair, k, told.answer.of_pair(name, single)) for k, name in enumerate(pair.names)] if pair else []
    rows.sort(key=lambda r: -r.probability)
    named = {(r.effect, r.target) for r in rows}
    others = []
    for candidate in compared.candidates:
        share = shares.get(id(candidate))
        one = row(candidate, 0, 0.0 if share is None else told.answer.of(share))
        if (one.effect, one.target) not in named:
            others.append(one)
    return (*rows, *sorted(others, key=lambda r: (-r.probability, -r.evidence)))


def _values(clips: Clips, fit: JointFit, k: int) -> dict[str, Value]:
    """Parameters of one effect, as of one clip."""
    covariance = np.linalg.inv(fit.curvature.schur) * max(1.0, clips.misfit(fit))
    # Shared coordinates: the base model's, then the terms'.
    terms = fit.hypothesis.terms
    first = fit.hypothesis.count - sum(int(o.free.sum()) for o in terms[k:])
    return values_of(terms[k], fit.z[first:], covariance[first:, first:], clips.frames)
