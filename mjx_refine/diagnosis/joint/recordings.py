"""The diagnosis of several recordings of poses of one set-up."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mjx_refine.diagnosis.hypothesis import Hypothesis
from mjx_refine.diagnosis.joint.answer import Said, ranked, said, to_judge
from mjx_refine.diagnosis.joint.fit import Clips, JointFit
from mjx_refine.diagnosis.joint.heldout import EARLY, Foretold, Outside, early_part, foretell, split
from mjx_refine.diagnosis.joint.hypothesis import JointHypothesis, common_scenes
from mjx_refine.diagnosis.joint.search import JointCandidate, JointCompared, Seen, compare_together
from mjx_refine.diagnosis.poses.data import Poses
from mjx_refine.diagnosis.poses.diagnose import UNCALIBRATED, check_motion, check_poses, columns_of, noise_words, words
from mjx_refine.diagnosis.poses.fit import VIDEO, PosesFit, rate_of
from mjx_refine.diagnosis.poses.heldout import Errors, errors_of
from mjx_refine.diagnosis.poses.start import fit_base, poses_space, started
from mjx_refine.diagnosis.poses.where import describe, misfit_map, seen_frames
from mjx_refine.diagnosis.result import ClipGap, Diagnosis, Gap, Place, PoseErrors
from mjx_refine.diagnosis.search import view_of
from mjx_refine.diagnosis.verdict import LITTLE
from mjx_refine.diagnosis.where import places_of
from mjx_refine.effects import catalogue
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.sim.c import MujocoSimulator

SERIES = tuple(name for name, kind in catalogue().items() if any(p.length < 0 for p in kind.parameters))
"""Effects with a number for every frame: no two clips share those."""


def diagnose_recordings(
    scenes: Sequence[Scene],
    poses: Sequence[Poses],
    *,
    without: tuple[str, ...] = (),
    seed: int = 0,
    threads: int | None = None,
    told: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Says what a set-up's simulation lacks to replay several recordings of it, and how far that closes the gap.

    Args:
      scenes: one a recording, or one for all; of what they share the medians count.
      poses: the recordings; each has a start of its own. About half are fitted, the others judged.
      without: effects to leave out of the catalogue; those of camera and picture always are.
      seed: of everything random, also of which recordings are judged.
      threads: of the simulator; all cores by default.
      told: called with a line for each step.

    Raises:
      InputError: scenes differ in kind or have effects, names do not match, nothing moves, or there are too few samples.
    """
    began = time.monotonic()
    told = told or (lambda line: None)
    scenes = _matched(scenes, poses)
    set_up = _SetUp(scenes, poses, threads)
    fitted, judged = split(len(poses), seed)
    clips = Clips([set_up.clips[k] for k in fitted])
    blank = [Observation(np.zeros((c.frames - 1, 8, 8, 2), np.float32), None, c.simulator.fps) for c in clips.clips]

    def view(c: int, part):
        return view_of(clips.clips[c], part, blank[c], set_up.columns[fitted[c]], hidden=False)

    left_out = {*without, *SERIES, *(name for name, kind in catalogue().items() if not kind.physical)}
    hypothesis = JointHypothesis(tuple(Hypothesis(set_up.spaces[k]) for k in fitted))
    seen = Seen(view, scenes[0].names)
    compared = compare_together(clips, lambda: _begin(clips, hypothesis, seed, told), seen, tuple(left_out), seed, told)
    outside = _outside(set_up, compared, fitted, judged, seed, told)
    answer = said(clips, compared, outside, 1.0, seed)
    told("report")
    return _result(set_up, clips, compared, outside, answer, (fitted, judged), view, seed, began)


def _matched(scenes: Sequence[Scene], poses: Sequence[Poses]) -> list[Scene]:
    """A scene a recording, all of one kind."""
    if len(scenes) not in (1, len(poses)):
        raise InputError(
            f"{len(scenes)} scenes and {len(poses)} recordings; expected as many of each, or one scene for all"
        )
    scenes = list(scenes) * (len(poses) if len(scenes) == 1 else 1)
    kinds = [(scene.names, scene.shapes) for scene in scenes]
    for k, kind in enumerate(kinds):
        if kind != kinds[0]:
            raise InputError(
                f"scene {k + 1} of {len(scenes)} holds {', '.join(kind[0])} ({', '.join(kind[1])}); expected the objects "
                f"of the first, {', '.join(kinds[0][0])} ({', '.join(kinds[0][1])}), since they share a set-up"
            )
    return scenes


class _SetUp:
    """Residuals and base models' spaces of all recordings."""

    def __init__(self, scenes: list[Scene], poses: Sequence[Poses], threads: int | None):
        self.names = [Path(one.source).name for one in poses]
        self.columns = [columns_of(scene, one) for scene, one in zip(scenes, poses, strict=True)]
        for scene, one in zip(scenes, poses, strict=True):
            check_poses(scene, one)
        rate = rate_of(np.cumsum(np.concatenate([np.diff(one.time) for one in poses])))
        simulator = MujocoSimulator(scenes[0].shapes, rate, threads)
        self.clips, self.spaces = [], []
        for scene, one, columns in zip(common_scenes(scenes), poses, self.columns, strict=True):
            # A tracker's samples that lie closer than a video's frames err together.
            weight = min(1.0, VIDEO * float(np.median(np.diff(one.time))))
            clip = PosesFit(simulator, one, columns, weight)
            check_motion(clip, one)
            self.clips.append(clip)
            self.spaces.append(poses_space(started(scene, one, columns)))


def _begin(clips: Clips, hypothesis: JointHypothesis, seed: int, told: Callable[[str], None]) -> JointFit:
    """Each recording by itself, then all from the medians of what they share."""
    alone = []
    for c, (clip, part) in enumerate(zip(clips.clips, hypothesis.parts, strict=True)):
        told(f"base model, recording {c + 1} of {len(clips)}")
        alone.append(fit_base(clip, part.space, seed).z)
    z = hypothesis.joined(alone)
    told("base model, all recordings")
    rough = clips.at(hypothesis, z)
    for c, clip in enumerate(clips.clips):
        own, at = clips.own(rough, c)
        z[hypothesis.index[c][~hypothesis.masks[c]]] = clip.fit(own, at, 6).z
    return clips.fit(hypothesis, z, 12)


def _outside(
    set_up: _SetUp, compared: JointCompared, fitted, judged, seed: int, told: Callable[[str], None]
) -> list[tuple[JointCandidate, Outside]]:
    """What the base model and the best candidates foretell of the held-out recordings."""

    def foretold(fit: JointFit) -> tuple[Foretold, ...]:
        rows = []
        for k in judged:
            clip = set_up.clips[k]
            part = dataclasses.replace(fit.hypothesis.parts[0], space=set_up.spaces[k])
            z = np.zeros(part.dimension)
            shared = JointHypothesis((part,)).masks[0]
            z[shared] = fit.z[: fit.hypothesis.count]
            rows.append(foretell(clip, part, z, early_part(clip.time), seed + k))
        return tuple(rows)

    told("held-out recordings")
    before = foretold(compared.base)
    result = []
    for candidate in to_judge(compared):
        told(f"held-out recordings, {' and '.join(candidate.names)}")
        result.append((candidate, Outside(before, foretold(candidate.fit))))
    return result or [(JointCandidate(compared.base, 0.0), Outside(before, before))]


# --- the answer -------------------------------------------------------------------------------------------------------


def _result(
    set_up: _SetUp, clips: Clips, compared: JointCompared, outside, told: Said, roles, view, seed: int, began: float
) -> Diagnosis:
    base = compared.base
    shown = told.best.fit if told.best else base
    judging = next(o for c, o in outside if told.shown is None or c is told.shown)
    rated = judging if told.best else Outside(judging.before, judging.before)
    first = clips.clips[0]
    maps = [misfit_map(first, fit.parts[0]) for fit in (base, shown)]
    seen = seen_frames(first)
    errors = [_later(set_up, roles[1], side) for side in (rated.before, rated.after)]
    parts = [fit.parts[0] for fit in (base, shown)]
    plain = [_middle([_root(errors_of(c, p)) for c, p in zip(clips.clips, compared.plain.parts, strict=True)])]
    return Diagnosis(
        verdict=told.verdict,
        gap=_gap(rated, [_middle(e) for e in errors], set_up, roles[1], seed),
        where=_where(clips, base, told.best.fit if told.best else None, view, roles[0]),
        candidates=ranked(clips, compared, told, outside) if compared.candidates else (),
        residual=_described(clips, base, view, set_up, roles[0]),
        remaining=_described(clips, shown, view, set_up, roles[0]),
        base=parts[0].hypothesis.scene(parts[0].z, first.frames),
        scene=parts[1].hypothesis.scene(parts[1].z, first.frames),
        matching=tuple(j + 1 if j >= 0 else -1 for j in set_up.columns[0]),
        map_before=np.where(seen, np.sqrt(maps[0][0] / first.weight), np.nan),
        map_after=np.where(seen, np.sqrt(maps[1][0] / first.weight), np.nan),
        channels=maps[0][1],
        notes=_notes(set_up, clips, compared, told, judging, roles, plain[0]),
        signs=dataclasses.asdict(told.signs),
        seconds=time.monotonic() - began,
        rollouts=int(sum(c.rollouts for c in set_up.clips)),
        pose_errors=PoseErrors(
            first.time, *errors_of(first, parts[0]), *errors_of(first, parts[1]), (plain[0].position, plain[0].rotation)
        ),
        clips=_gaps(set_up, clips, base, shown, judging, rated, errors, roles),
    )


def _root(errors: tuple[np.ndarray, np.ndarray], chosen=slice(None)) -> Errors:
    values = [e[chosen][np.isfinite(e[chosen])] for e in errors]
    return Errors(*(float(np.sqrt(np.mean(v**2))) if v.size else math.nan for v in values))


def _later(set_up: _SetUp, judged: Sequence[int], told: Sequence[Foretold]) -> list[Errors]:
    """Errors of held-out recordings in what was foretold."""
    clips = [set_up.clips[k] for k in judged]
    return [_root(errors_of(c, f.fit), ~early_part(c.time)) for c, f in zip(clips, told, strict=True)]


def _middle(errors: Sequence[Errors]) -> Errors:
    """Medians over recordings."""
    rows = np.array([[e.position, e.rotation] for e in errors])
    known = [row[np.isfinite(row)] for row in rows.T]
    return Errors(*(float(np.median(row)) if row.size else math.nan for row in known))


def _gap(rated: Outside, errors: list[Errors], set_up: _SetUp, judged: Sequence[int], seed: int) -> Gap:
    before, after, floor = rated.numbers
    low, high = rated.interval(seed)
    names = ", ".join(set_up.names[k] for k in judged)
    return Gap(
        metric="positions and rotations against the measured ones, root mean square over what was foretold of each held-out "
        "recording, median over these, in widths of the noise",
        held_out=f"{names}: from {100 * EARLY:.0f} % of their time on; only their starts were fitted, on what is before",
        before=before,
        after=after,
        noise_floor=floor,
        closed=rated.closed,
        closed_low=low,
        closed_high=high,
        iou_before=math.nan,
        iou_after=math.nan,
        epe_before=math.nan,
        epe_after=math.nan,
        position_before=errors[0].position,
        position_after=errors[1].position,
        rotation_before=errors[0].rotation,
        rotation_after=errors[1].rotation,
    )


def _where(clips: Clips, base: JointFit, best: JointFit | None, view, fitted: Sequence[int]) -> tuple[Place, ...]:
    """The places of all fitted recordings; shares are of their whole misfit."""
    energies, found = [], []
    for c, clip in enumerate(clips.clips):
        before, after = (None if fit is None else misfit_map(clip, fit.parts[c]) for fit in (base, best))
        assert before is not None
        scaled = (before[0] / clip.weight, *before[1:])
        energies.append(float(np.maximum(scaled[0] - 1.0, 0.0).sum()))
        part = best.parts[c] if best else None
        left = None if after is None else after[0] / clip.weight
        found.append(places_of(scaled, left, base.parts[c], part, view(c, part or base.parts[c])))
    total = max(sum(energies), 1e-9)
    places = [
        dataclasses.replace(p, share=p.share * e / total, clip=k)
        for several, e, k in zip(found, energies, fitted, strict=True)
        for p in several
    ]
    return tuple(sorted(places, key=lambda p: -p.share)[:8])


def _described(clips: Clips, fit: JointFit, view, set_up: _SetUp, fitted: Sequence[int]) -> str:
    """The recording with the largest misfit, in plain words."""
    each = [clip.misfit(part) for clip, part in zip(clips.clips, fit.parts, strict=True)]
    c = int(np.argmax(each))
    text = describe(clips.clips[c], fit.parts[c], view(c, fit.parts[c]))
    return f"Of {len(clips)} fitted recordings the farthest off is {set_up.names[fitted[c]]}: {text}"


def _gaps(set_up: _SetUp, clips: Clips, base, shown, judging: Outside, rated: Outside, errors, roles):
    rows: dict[int, ClipGap] = {}
    for c, k in enumerate(roles[0]):
        clip = clips.clips[c]
        told = [_root(errors_of(clip, fit.parts[c])) for fit in (base, shown)]
        misfits = [float(np.sqrt(clip.misfit(fit.parts[c]))) for fit in (base, shown)]
        rows[k] = _clip_gap(set_up.names[k], True, misfits, told)
    for c, k in enumerate(roles[1]):
        sides = [rated.before[c].error, rated.after[c].error]
        one = _clip_gap(set_up.names[k], False, sides, [errors[0][c], errors[1][c]])
        rows[k] = dataclasses.replace(one, noise_floor=rated.before[c].floor, gain=float(judging.gains[c]))
    return tuple(rows[k] for k in sorted(rows))


def _clip_gap(source: str, fitted: bool, sides: list[float], told: list[Errors]) -> ClipGap:
    return ClipGap(
        source,
        fitted,
        *sides,
        position_before=told[0].position,
        position_after=told[1].position,
        rotation_before=told[0].rotation,
        rotation_after=told[1].rotation,
    )


def _notes(set_up: _SetUp, clips: Clips, compared: JointCompared, told: Said, judging: Outside, roles, plain: Errors):
    notes = [UNCALIBRATED, noise_words(clips.clips[0])]
    notes.append(
        f"{len(roles[0])} recordings were fitted, {len(roles[1])} judged, chosen by the seed; maps and plots are of "
        f"{set_up.names[roles[0][0]]}."
    )
    weights = {round(clip.weight, 2) for clip in set_up.clips}
    if min(weights) < 1:
        notes.append(f"Samples closer than a video's frames err together: each counts as {min(weights):.2g} of one.")
    if compared.impacts:
        notes.append(
            f"{compared.impacts} impacts may each err by {8 * compared.slackness:.2g} % of their change of velocity before "
            "anything else is blamed, which is likeliest by the fitted recordings' residuals. The base model's fit in which "
            f"they may not err is off by {words(plain)} (median over these)."
        )
    for one in (c for c in told.refuted if c.lead > LITTLE):
        notes.append(
            f"{' and '.join(one.names)} leads by {one.lead:.0f} on the fitted recordings, but does not foretell the others "
            "better than the base model does: not named."
        )
    if told.shown is not None and told.best is None and len(told.shown.names):
        before, after, _ = judging.numbers
        notes.append(
            f"The best candidate, {' and '.join(told.shown.names)}, would bring the held-out error from {before:.3g} to "
            f"{after:.3g} noise widths."
        )
    return tuple(notes)
