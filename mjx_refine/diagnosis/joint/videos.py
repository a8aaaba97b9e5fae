"""The diagnosis of several clips of one set-up, filmed by one camera."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mjx_refine.diagnosis.diagnose import prepared
from mjx_refine.diagnosis.fits.base import base_space, stored_base
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.shown import view_of
from mjx_refine.diagnosis.fits.store import Store
from mjx_refine.diagnosis.joint.heldout import Foretold
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
from mjx_refine.diagnosis.misfit.signs import map_of
from mjx_refine.diagnosis.misfit.where import describe, misfit_map
from mjx_refine.diagnosis.result import Diagnosis
from mjx_refine.effects.kind import FitView
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.recalled import Recalling

UNCALIBRATED = "Probabilities were calibrated on single clips: read the evidence and the gap on held-out clips as well."


def diagnose_clips(
    scenes: Sequence[Scene],
    observations: Sequence[Observation],
    *,
    without: tuple[str, ...] = (),
    seed: int = 0,
    threads: int | None = None,
    told: Callable[[str], None] | None = None,
    store: Store | None = None,
) -> Diagnosis:
    """Says what a set-up's simulation lacks to replay several clips of it, and how far that closes the gap.

    Args:
      scenes: one a clip, refined, without effects; of sizes, masses, contacts, camera and gravity, which the clips share,
        the medians count.
      observations: the clips. About half are fitted, the others judged; the first is always fitted.
      without: effects to leave out of the catalogue; those that happen once (``PASSING``) always are.
      seed: of everything random, also of which clips are judged.
      threads: of the simulator; all cores by default.
      told: called with a line for each step.
      store: where finished fits are kept, so that an interrupted call goes on; nowhere by default.

    Raises:
      InputError: there are fewer than two clips, scenes differ in kind, have effects or do not match their clips, nothing
        moves, or a clip is too short.
    """
    began = time.monotonic()
    if len(observations) < 2:
        raise InputError(f"{len(observations)} clips; expected two and more of one set-up; `diagnose` takes one")
    set_up = Videos(matched(scenes, len(observations), "clips"), observations, threads)
    course = run(set_up, scenes[0].names, without, seed, told, store)
    return _result(course, set_up, seed, began)


class Videos(SetUp):
    """Clips of a set-up.

    Args:
      scenes: one a clip, of one kind.
      observations: the clips.
      threads: of the simulator.
    """

    def __init__(self, scenes: list[Scene], observations: Sequence[Observation], threads: int | None):
        self.names = [Path(one.source).name for one in observations]
        if len(set(self.names)) < len(self.names):
            self.names = [f"{k + 1} ({name})" for k, name in enumerate(self.names)]
        self.observations = observations
        check_once([(one.flow,) for one in observations], self.names)
        ready = [prepared(scene, one, threads) for scene, one in zip(scenes, observations, strict=True)]
        self.problems = [problem for problem, _, _ in ready]
        self.matchings = [start.matching for _, start, _ in ready]
        simulators = {o.fps: Recalling(MujocoSimulator(scenes[0].shapes, o.fps, threads)) for o in observations}
        self.clips = [
            ClipFit(simulators[one.fps], measured, one.size, one.length)
            for one, (_, _, measured) in zip(observations, ready, strict=True)
        ]
        self.spaces = [base_space(scene) for scene in common_scenes([start.scene for _, start, _ in ready])]

    def alone(self, k: int, seed: int) -> Fit:
        return stored_base(self.clips[k], self.spaces[k], self.observations[k], self.matchings[k])

    def time(self, k: int) -> np.ndarray:
        return np.arange(self.observations[k].length) / self.observations[k].fps

    def view(self, k: int, part: Fit, hidden: bool = True) -> FitView:
        return view_of(self.clips[k], part, self.observations[k], self.matchings[k], hidden=hidden)

    def misfit(self, k: int, part: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return misfit_map(self.clips[k], part)

    def described(self, k: int, part: Fit) -> str:
        return describe(self.clips[k], part, self.view(k, part, hidden=False))


def _result(course: Course, set_up: Videos, seed: int, began: float) -> Diagnosis:
    gap = numbers(course, "centroids, outlines, what flow on and beside objects has in common", "clip", seed)
    before, after = (_scores(set_up, course.judged, told) for told in (course.rated.before, course.rated.after))
    gap = dataclasses.replace(gap, iou_before=before[0], iou_after=after[0], epe_before=before[1], epe_after=after[1])
    first, parts = set_up.clips[0], [fit.parts[0] for fit in (course.base, course.shown)]
    gaps = clip_gaps(course)
    return result(
        course,
        gap,
        tuple(gaps[k] for k in sorted(gaps)),
        _notes(set_up),
        (map_of(first, parts[0]), map_of(first, parts[1]), misfit_map(first, parts[0])[1]),
        set_up.matchings[0],
        time.monotonic() - began,
    )


def _scores(set_up: Videos, judged: Sequence[int], told: Sequence[Foretold]) -> tuple[float, float]:
    """Medians over the held-out clips of IoU and end-point error [px], full resolution, whole clip."""
    rows = []
    for k, one in zip(judged, told, strict=True):
        scene = one.fit.hypothesis.scene(one.fit.z, set_up.clips[k].frames)
        score = set_up.problems[k].score([scene], set_up.matchings[k])
        rows.append((float(score.iou[0]), float(score.epe[0])))
    iou, epe = np.median(rows, 0)
    return float(iou), float(epe)


def _notes(set_up: Videos) -> list[str]:
    notes = [UNCALIBRATED]
    for name, matching in zip(set_up.names, set_up.matchings, strict=True):
        lost = [n for n, i in zip(set_up.problems[0].starts[0].scene.names, matching, strict=True) if i < 0]
        if lost:
            notes.append(f"No mask of {name} belongs to {', '.join(lost)}: nothing is known of it there.")
    return notes
