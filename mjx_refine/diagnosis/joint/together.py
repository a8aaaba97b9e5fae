"""The course of a diagnosis of several clips, whether of pictures or of poses, and its result."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from mjx_refine.diagnosis.answer.verdict import LITTLE
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.store import Store
from mjx_refine.diagnosis.joint.answer import Said, ranked, said, to_judge
from mjx_refine.diagnosis.joint.fit import Clips, JointFit
from mjx_refine.diagnosis.joint.heldout import EARLY, Foretold, Outside, early_part, excused, foretell, split
from mjx_refine.diagnosis.joint.hypothesis import JointHypothesis
from mjx_refine.diagnosis.joint.search import JointCandidate, JointCompared, Seen, compare_together
from mjx_refine.diagnosis.joint.slack import GRID
from mjx_refine.diagnosis.misfit.where import places_of
from mjx_refine.diagnosis.result import ClipGap, Diagnosis, Gap, Place, PoseErrors
from mjx_refine.effects.kind import FitView
from mjx_refine.errors import InputError
from mjx_refine.scene import Scene
from mjx_refine.space import Space

PASSING = ("push", "dropped_frames", "camera_shake")
"""Effects that happen once: they belong to a clip and not to a set-up, and come at another moment in every clip."""


class SetUp(abc.ABC):
    """All clips of a set-up, fitted and judged.

    Attributes:
      names: of the clips.
      clips: their residuals.
      spaces: of the base model, with the same shared parameters.
      least: misfit below which leads are not counted in units of it.
    """

    names: list[str]
    clips: Sequence[ClipFit]
    spaces: list[Space]
    least: float = 0.3

    @abc.abstractmethod
    def alone(self, k: int, seed: int) -> Fit:
        """The base model's fit of one clip by itself."""

    @abc.abstractmethod
    def time(self, k: int) -> np.ndarray:
        """When each frame or sample was taken."""

    @abc.abstractmethod
    def view(self, k: int, part: Fit) -> FitView:
        """What kinds of effects see of a fit."""

    @abc.abstractmethod
    def misfit(self, k: int, part: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As ``where.misfit_map``."""

    @abc.abstractmethod
    def described(self, k: int, part: Fit) -> str:
        """The misfit in plain words."""


@dataclasses.dataclass(frozen=True)
class Course:
    """What a diagnosis of several clips came to.

    Attributes:
      set_up: the clips.
      fitted: which were fitted.
      judged: which were held out.
      clips: the fitted ones.
      compared: their hypotheses.
      outside: candidates that were judged, with what they foretold.
      told: the answer.
      judging: what ``told.shown`` foretold, or the base model where there is none.
    """

    set_up: SetUp
    fitted: tuple[int, ...]
    judged: tuple[int, ...]
    clips: Clips
    compared: JointCompared
    outside: list[tuple[JointCandidate, Outside]]
    told: Said
    judging: Outside

    @property
    def base(self) -> JointFit:
        return self.compared.base

    @property
    def shown(self) -> JointFit:
        """The fit behind the verdict."""
        return self.told.best.fit if self.told.best else self.base

    @property
    def rated(self) -> Outside:
        """The base model before, the verdict's after."""
        return self.judging if self.told.best else Outside(self.judging.before, self.judging.before)


def matched(scenes: Sequence[Scene], count: int, source: str) -> list[Scene]:
    """A scene a clip, all of one kind.

    Raises:
      InputError: there are too few or too many, or they differ in kind.
    """
    if len(scenes) not in (1, count):
        raise InputError(f"{len(scenes)} scenes and {count} {source}; expected as many of each, or one scene for all")
    scenes = list(scenes) * (count if len(scenes) == 1 else 1)
    kinds = [(scene.names, scene.shapes) for scene in scenes]
    for k, kind in enumerate(kinds):
        if kind != kinds[0]:
            raise InputError(
                f"scene {k + 1} of {len(scenes)} holds {', '.join(kind[0])} ({', '.join(kind[1])}); expected the objects "
                f"of the first, {', '.join(kinds[0][0])} ({', '.join(kinds[0][1])}), since they share a set-up; diagnose "
                "other set-ups by themselves"
            )
    return scenes


def check_once(arrays: Sequence[tuple[np.ndarray, ...]], names: Sequence[str]) -> None:
    """Refuses the same clip twice: what was fitted would judge itself.

    Raises:
      InputError: two clips hold the same numbers.
    """
    for k, one in enumerate(arrays):
        for j, other in enumerate(arrays[:k]):
            if all(
                a.shape == b.shape and np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True)
            ):
                raise InputError(
                    f"{names[k]}: the same clip as {names[j]}; expected different ones, since some judge what others "
                    "fitted; leave one out"
                )


def run(
    set_up: SetUp,
    names: tuple[str, ...],
    without: Sequence[str],
    seed: int,
    told: Callable[[str], None] | None,
    store: Store | None,
) -> Course:
    """Fits some clips and judges on the others.

    Args:
      set_up: the clips.
      names: of the objects.
      without: effects that are left out.
      seed: of everything random.
      told: called with a line for each step.
      store: where finished fits are kept.
    """
    told = told or (lambda line: None)
    for clip in set_up.clips:
        clip.store = store or clip.store
    fitted, judged = split(len(set_up.clips), seed)
    clips = Clips([set_up.clips[k] for k in fitted])
    hypothesis = JointHypothesis(tuple(Hypothesis(set_up.spaces[k]) for k in fitted))

    def begin() -> JointFit:
        return _begin(set_up, fitted, clips, hypothesis, seed, told)

    seen = Seen(lambda c, part: set_up.view(fitted[c], part), names)
    compared = compare_together(clips, begin, seen, (*without, *PASSING), seed, told)
    outside = _outside(set_up, compared, judged, seed, told)
    answer = said(clips, compared, outside, set_up.least, seed)
    judging = next(o for c, o in outside if answer.shown is None or c is answer.shown)
    told("report")
    return Course(set_up, fitted, judged, clips, compared, outside, answer, judging)


def _begin(set_up: SetUp, fitted, clips: Clips, hypothesis: JointHypothesis, seed: int, told) -> JointFit:
    """Each clip by itself, then all from the medians of what they share."""
    alone = []
    for c, k in enumerate(fitted):
        told(f"base model, clip {c + 1} of {len(clips)}")
        alone.append(set_up.alone(k, seed).z)
    z = hypothesis.joined(alone)
    told("base model, all clips")
    rough = clips.at(hypothesis, z)
    for c, clip in enumerate(clips.clips):
        own, at = clips.own(rough, c)
        z[hypothesis.index[c][~hypothesis.masks[c]]] = clip.fit(own, at, 6).z
    return clips.fit(hypothesis, z, 12)


def _outside(set_up: SetUp, compared: JointCompared, judged, seed: int, told) -> list[tuple[JointCandidate, Outside]]:
    """What the base model and the best candidates foretell of the held-out clips."""

    def foretold(fit: JointFit) -> tuple[Foretold, ...]:
        rows = []
        for k in judged:
            part = dataclasses.replace(fit.hypothesis.parts[0], space=set_up.spaces[k])
            z = np.zeros(part.dimension)
            z[JointHypothesis((part,)).masks[0]] = fit.z[: fit.hypothesis.count]
            rows.append(foretell(set_up.clips[k], part, z, early_part(set_up.time(k)), seed + k))
        return tuple(rows)

    told("held-out clips")
    before = tuple(
        excused(set_up.clips[k], one, early_part(set_up.time(k)), compared.slackness)
        for k, one in zip(judged, foretold(compared.base), strict=True)
    )
    result = []
    for candidate in to_judge(compared):
        told(f"held-out clips, {' and '.join(candidate.names)}")
        result.append((candidate, Outside(before, foretold(candidate.fit))))
    return result or [(JointCandidate(compared.base, 0.0), Outside(before, before))]


# --- the answer -------------------------------------------------------------------------------------------------------


def result(
    course: Course,
    gap: Gap,
    gaps: tuple[ClipGap, ...],
    notes: Sequence[str],
    maps: tuple[np.ndarray, np.ndarray, np.ndarray],
    matching: tuple[int, ...],
    seconds: float,
    pose_errors: PoseErrors | None = None,
) -> Diagnosis:
    """All of it; scenes and maps are the first clip's, which is always fitted."""
    first = [fit.parts[0] for fit in (course.base, course.shown)]
    frames = course.clips.clips[0].frames
    return Diagnosis(
        verdict=course.told.verdict,
        gap=gap,
        where=_where(course),
        candidates=ranked(course.clips, course.compared, course.told, course.outside),
        residual=_described(course, course.base),
        remaining=_described(course, course.shown),
        base=first[0].hypothesis.scene(first[0].z, frames),
        scene=first[1].hypothesis.scene(first[1].z, frames),
        matching=matching,
        map_before=maps[0],
        map_after=maps[1],
        channels=maps[2],
        notes=(*notes, *_notes(course)),
        signs=dataclasses.asdict(course.told.signs),
        seconds=seconds,
        rollouts=int(sum(clip.rollouts for clip in course.set_up.clips)),
        pose_errors=pose_errors,
        clips=gaps,
    )


def numbers(course: Course, measured: str, source: str, seed: int) -> Gap:
    """The gap in noise widths; what it is in pictures or metres is added by others.

    Args:
      measured: what is held against what.
      source: what one of the clips is called.
    """
    metric = f"{measured}, root mean square over what was foretold of each held-out {source}, median over these, in noise widths"
    held_out = (
        f"{', '.join(course.set_up.names[k] for k in course.judged)}: from {100 * EARLY:.0f} % of their time on; only their "
        "starts were fitted, on what is before"
    )
    before, after, floor = course.rated.numbers
    low, high = course.rated.interval(seed)
    nan = float("nan")
    return Gap(metric, held_out, before, after, floor, course.rated.closed, low, high, nan, nan, nan, nan)


def clip_gaps(course: Course) -> dict[int, ClipGap]:
    """Errors of every clip in noise widths."""
    rows = {}
    for c, k in enumerate(course.fitted):
        sides = [float(np.sqrt(course.clips.clips[c].misfit(f.parts[c]))) for f in (course.base, course.shown)]
        rows[k] = ClipGap(course.set_up.names[k], True, *sides)
    for c, k in enumerate(course.judged):
        rated = course.rated
        rows[k] = ClipGap(
            course.set_up.names[k],
            False,
            rated.before[c].error,
            rated.after[c].error,
            rated.before[c].floor,
            float(course.judging.gains[c]),
        )
    return rows


def _where(course: Course) -> tuple[Place, ...]:
    """The places of all fitted clips; shares are of their whole misfit."""
    energies, found = [], []
    best = course.told.best.fit if course.told.best else None
    for c, k in enumerate(course.fitted):
        base, part = course.base.parts[c], best.parts[c] if best else None
        before = course.set_up.misfit(k, base)
        after = None if part is None else course.set_up.misfit(k, part)[0]
        energies.append(float(np.maximum(before[0] - 1.0, 0.0).sum() + np.maximum(before[2] - 1.0, 0.0).sum()))
        found.append(places_of(before, after, base, part, course.set_up.view(k, part or base)))
    total = max(sum(energies), 1e-9)
    places = [
        dataclasses.replace(p, share=p.share * e / total, clip=k)
        for several, e, k in zip(found, energies, course.fitted, strict=True)
        for p in several
    ]
    return tuple(sorted(places, key=lambda p: -p.share)[:8])


def _described(course: Course, fit: JointFit) -> str:
    """The clip with the largest misfit, in plain words."""
    each = [clip.misfit(part) for clip, part in zip(course.clips.clips, fit.parts, strict=True)]
    c = int(np.argmax(each))
    k = course.fitted[c]
    text = course.set_up.described(k, fit.parts[c])
    return f"Of {len(each)} fitted clips the farthest off is {course.set_up.names[k]}: {text}"


def _notes(course: Course) -> list[str]:
    compared, told = course.compared, course.told
    notes = [
        f"{', '.join(PASSING)} were left out: what happens once belongs to a clip, not to a set-up.",
        f"{len(course.fitted)} clips were fitted, {len(course.judged)} judged, chosen by the seed; maps and plots are of "
        f"{course.set_up.names[0]}.",
    ]
    if compared.impacts:
        notes.append(
            f"{compared.impacts} impacts may each err by {8 * compared.slackness:.2g} % of their change of velocity before "
            f"anything else is blamed, the likeliest of {', '.join(f'{8 * s:g}' for s in GRID)} by the fitted clips. Of the "
            f"held-out error of {course.judging.numbers[0]:.3g} noise widths, {course.judging.excused:.3g} are what that, "
            "noise, and what is not known of the starts may do (medians)."
        )
    for one in (c for c in told.refuted if c.lead > LITTLE):
        notes.append(
            f"{' and '.join(one.names)} leads by {one.lead:.0f} on the fitted clips, but does not foretell the others better "
            "than the base model does: not named."
        )
    if told.shown is not None and told.best is None and told.shown.names:
        before, after, _ = course.judging.numbers
        notes.append(
            f"The best candidate, {' and '.join(told.shown.names)}, takes the held-out error from {before:.3g} to {after:.3g} "
            "noise widths."
        )
    return notes
