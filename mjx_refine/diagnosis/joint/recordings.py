"""The diagnosis of several recordings of poses of one set-up."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from mjx_refine.diagnosis.fits.fit import Fit
from mjx_refine.diagnosis.fits.shown import view_of
from mjx_refine.diagnosis.fits.store import Store
from mjx_refine.diagnosis.joint.heldout import early_part
from mjx_refine.diagnosis.joint.hypothesis import common_scenes
from mjx_refine.diagnosis.joint.together import (
    Course,
    SetUp,
    check_once,
    clip_gaps,
    matched,
    numbers,
    result,
    run,
)
from mjx_refine.diagnosis.poses.data import Poses
from mjx_refine.diagnosis.poses.diagnose import UNCALIBRATED, check_motion, check_poses, columns_of, noise_words, words
from mjx_refine.diagnosis.poses.fit import VIDEO, PosesFit, rate_of
from mjx_refine.diagnosis.poses.heldout import Errors, errors_of
from mjx_refine.diagnosis.poses.start import fit_base, poses_space, started
from mjx_refine.diagnosis.poses.where import describe, misfit_map, seen_frames
from mjx_refine.diagnosis.result import ClipGap, Diagnosis, Gap, PoseErrors
from mjx_refine.effects import catalogue
from mjx_refine.effects.kind import FitView
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.recalled import Recalling

_Gap = TypeVar("_Gap", Gap, ClipGap)


def diagnose_recordings(
    scenes: Sequence[Scene],
    poses: Sequence[Poses],
    *,
    without: tuple[str, ...] = (),
    seed: int = 0,
    threads: int | None = None,
    told: Callable[[str], None] | None = None,
    store: Store | None = None,
) -> Diagnosis:
    """Says what a set-up's simulation lacks to replay several recordings of it, and how far that closes the gap.

    Args:
      scenes: one a recording, or one for all; of what they share the medians count.
      poses: the recordings; each has a start of its own. About half are fitted, the others judged.
      without: effects to leave out of the catalogue; those of camera and picture, and those that happen once, always are.
      seed: of everything random, also of which recordings are judged.
      threads: of the simulator; all cores by default.
      told: called with a line for each step.
      store: where finished fits are kept, so that an interrupted call goes on; nowhere by default.

    Raises:
      InputError: scenes differ in kind or have effects, names do not match, nothing moves, or there are too few samples.
    """
    began = time.monotonic()
    set_up = Recordings(matched(scenes, len(poses), "recordings"), poses, threads)
    left_out = (*without, *(name for name, kind in catalogue().items() if not kind.physical))
    course = run(set_up, scenes[0].names, left_out, seed, told, store)
    return _result(course, set_up, seed, began)


class Recordings(SetUp):
    """Recordings of poses.

    Args:
      scenes: one a recording, of one kind.
      poses: the recordings.
      threads: of the simulator.
    """

    least = 1.0

    def __init__(self, scenes: list[Scene], poses: Sequence[Poses], threads: int | None):
        self.names = [Path(one.source).name for one in poses]
        self.columns = [columns_of(scene, one) for scene, one in zip(scenes, poses, strict=True)]
        for scene, one in zip(scenes, poses, strict=True):
            check_poses(scene, one)
        check_once([(one.time, one.position, one.quaternion) for one in poses], self.names)
        # One simulator for all, at the rate of their median sample.
        rate = rate_of(np.cumsum(np.concatenate([np.diff(one.time) for one in poses])))
        simulator = Recalling(MujocoSimulator(scenes[0].shapes, rate, threads))
        self.clips: list[PosesFit] = []
        self.spaces = []
        for scene, one, columns in zip(common_scenes(scenes), poses, self.columns, strict=True):
            # A tracker's samples that lie closer than a video's frames err together.
            weight = min(1.0, VIDEO * float(np.median(np.diff(one.time))))
            clip = PosesFit(simulator, one, columns, weight)
            check_motion(clip, one)
            self.clips.append(clip)
            self.spaces.append(poses_space(started(scene, one, columns)))

    def alone(self, k: int, seed: int) -> Fit:
        return fit_base(self.clips[k], self.spaces[k], seed)

    def time(self, k: int) -> np.ndarray:
        return self.clips[k].time

    def view(self, k: int, part: Fit) -> FitView:
        clip = self.clips[k]
        blank = Observation(np.zeros((clip.frames - 1, 8, 8, 2), np.float32), None, clip.simulator.fps)
        return view_of(clip, part, blank, self.columns[k], hidden=False)

    def misfit(self, k: int, part: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        energy, channel, beside = misfit_map(self.clips[k], part)
        return energy / self.clips[k].weight, channel, beside

    def described(self, k: int, part: Fit) -> str:
        return describe(self.clips[k], part, self.view(k, part))


# --- the answer -------------------------------------------------------------------------------------------------------


def _result(course: Course, set_up: Recordings, seed: int, began: float) -> Diagnosis:
    sides = [_later(set_up, course.judged, told) for told in (course.rated.before, course.rated.after)]
    before, after = (_middle(side) for side in sides)
    gap = numbers(course, "positions and rotations against the measured ones", "recording", seed)
    gap = _with_errors(gap, [before, after])
    clips = course.clips.clips
    plain = _middle([_root(errors_of(c, p)) for c, p in zip(clips, course.compared.plain.parts, strict=True)])  # type: ignore[arg-type]
    first, seen = set_up.clips[0], seen_frames(set_up.clips[0])
    parts = [fit.parts[0] for fit in (course.base, course.shown)]
    maps = [set_up.misfit(0, part) for part in parts]
    rooted = [np.where(seen, np.sqrt(energy), np.nan) for energy, _, _ in maps]
    errors = [errors_of(first, part) for part in parts]
    return result(
        course,
        gap,
        _gaps(course, set_up, sides),
        _notes(set_up, plain),
        (rooted[0], rooted[1], maps[0][1]),
        tuple(j + 1 if j >= 0 else -1 for j in set_up.columns[0]),
        time.monotonic() - began,
        PoseErrors(first.time, *errors[0], *errors[1], (plain.position, plain.rotation)),
    )


def _root(errors: tuple[np.ndarray, np.ndarray], chosen: slice | np.ndarray = slice(None)) -> Errors:
    values = [e[chosen][np.isfinite(e[chosen])] for e in errors]
    return Errors(*(float(np.sqrt(np.mean(v**2))) if v.size else math.nan for v in values))


def _later(set_up: Recordings, judged: Sequence[int], told) -> list[Errors]:
    """Errors of held-out recordings in what was foretold."""
    clips = [set_up.clips[k] for k in judged]
    return [_root(errors_of(c, f.fit), ~early_part(c.time)) for c, f in zip(clips, told, strict=True)]


def _middle(errors: Sequence[Errors]) -> Errors:
    """Medians over recordings."""
    rows = np.array([[e.position, e.rotation] for e in errors])
    known = [row[np.isfinite(row)] for row in rows.T]
    return Errors(*(float(np.median(row)) if row.size else math.nan for row in known))


def _gaps(course: Course, set_up: Recordings, sides: list[list[Errors]]) -> tuple[ClipGap, ...]:
    rows = clip_gaps(course)
    for c, k in enumerate(course.fitted):
        told = [_root(errors_of(set_up.clips[k], fit.parts[c])) for fit in (course.base, course.shown)]
        rows[k] = _with_errors(rows[k], told)
    for c, k in enumerate(course.judged):
        rows[k] = _with_errors(rows[k], [side[c] for side in sides])
    return tuple(rows[k] for k in sorted(rows))


def _with_errors(gap: _Gap, told: list[Errors]) -> _Gap:
    return dataclasses.replace(
        gap,
        position_before=told[0].position,
        position_after=told[1].position,
        rotation_before=told[0].rotation,
        rotation_after=told[1].rotation,
    )


def _notes(set_up: Recordings, plain: Errors) -> list[str]:
    notes = [UNCALIBRATED, noise_words(set_up.clips[0])]
    weight = min(clip.weight for clip in set_up.clips)
    if weight < 1:
        notes.append(f"Samples closer than a video's frames err together: each counts as {weight:.2g} of one.")
    notes.append(
        f"The base model's fit in which contacts may not err is off by {words(plain)} (median over the fitted recordings)."
    )
    return notes
