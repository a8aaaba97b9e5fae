"""The diagnosis of measured poses, from scene and poses to the answer."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable

import numpy as np

from mjx_refine.diagnosis.answer.verdict import Answer, answer, upheld
from mjx_refine.diagnosis.diagnose import ranked, verdict_of
from mjx_refine.diagnosis.fits.candidates import Candidate, Compared
from mjx_refine.diagnosis.fits.fit import Fit
from mjx_refine.diagnosis.fits.shown import view_of
from mjx_refine.diagnosis.fits.store import Store
from mjx_refine.diagnosis.misfit.heldout import HeldOut
from mjx_refine.diagnosis.misfit.signs import Signs, best_candidate, signs
from mjx_refine.diagnosis.misfit.where import places_of
from mjx_refine.diagnosis.poses.data import Poses
from mjx_refine.diagnosis.poses.fit import PosesFit, rate_of
from mjx_refine.diagnosis.poses.heldout import Errors, errors_of, held_out, total
from mjx_refine.diagnosis.poses.start import fit_base, poses_space, started
from mjx_refine.diagnosis.poses.where import describe, misfit_map, seen_frames
from mjx_refine.diagnosis.result import Diagnosis, Gap, PoseErrors
from mjx_refine.diagnosis.search.compare import compare
from mjx_refine.effects import catalogue
from mjx_refine.errors import InputError
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.sim.recalled import Recalling

LEAST_TIMES = 9
"""Samples that poses must have: fewer cannot be held out."""

MOST_FRAMES = 4000
"""Simulated frames that a recording may need."""

LEAST_MOTION = 5.0
"""How far something must move or turn [noise widths]."""

UNCALIBRATED = (
    "Probabilities were calibrated on videos, not on poses: read the evidence and the gap on held-out samples as well."
)


def diagnose_recording(
    scene: Scene,
    poses: Poses,
    *,
    without: tuple[str, ...] = (),
    seed: int = 0,
    threads: int | None = None,
    told: Callable[[str], None] | None = None,
    store: Store | None = None,
) -> Diagnosis:
    """Says where a scene's simulation and measured poses part, which effect parts them, and how far it closes the gap.

    Args:
      scene: sizes, masses, contacts; where its objects start and how fast is taken from the poses. Without effects.
      poses: what was measured; its names are those of objects of the scene.
      without: effects to leave out of the catalogue; those of camera and picture always are.
      seed: of everything random.
      threads: of the simulator; all cores by default.
      told: called with a line for each step.
      store: where finished fits are kept, so that an interrupted call goes on; nowhere by default.

    Raises:
      InputError: the scene has effects, the names do not match, nothing moves, or there are too few samples.
    """
    began = time.monotonic()
    columns = columns_of(scene, poses)
    check_poses(scene, poses)
    told = told or (lambda line: None)
    scene = started(scene, poses, columns)
    clip = PosesFit(Recalling(MujocoSimulator(scene.shapes, rate_of(poses.time), threads)), poses, columns)
    clip.store = store or clip.store
    check_motion(clip, poses)
    left_out = (*without, *(name for name, kind in catalogue().items() if not kind.physical))
    blank = Observation(np.zeros((clip.frames - 1, 8, 8, 2), np.float32), None, clip.simulator.fps)
    space = poses_space(scene)
    first: list[Errors] = []

    def begin() -> Fit:
        fit = fit_base(clip, space, seed)
        first.append(total(clip, fit))
        return fit

    compared = compare(clip, scene, blank, columns, left_out, seed, told, begin=begin)
    told("held-out samples")
    best = best_candidate(compared)
    outside = held_out(clip, compared.base, best.fit if best else None)
    found = unsettled(signs(clip, compared, outside[0].gain, outside[0].closed), compared)
    said = answer(found, [c.lead for c in compared.candidates])
    said = upheld(said, compared, found, lambda fit: held_out(clip, compared.base, fit)[0].closed)
    told("report")
    diagnosis = _result(clip, compared, outside, found, said, blank, columns, seed, began)
    return _with_plain(diagnosis, first[0], compared.impacts)


def _with_plain(diagnosis: Diagnosis, plain: Errors, impacts: int) -> Diagnosis:
    """With what the base model's first fit left, in which contacts were not allowed to err."""
    told = diagnosis.pose_errors
    if told is None or not impacts:
        return diagnosis
    note = f"The base model's fit in which they may not err is off by {words(plain)} over all samples."
    errors = dataclasses.replace(told, plain=(plain.position, plain.rotation))
    return dataclasses.replace(diagnosis, notes=(*diagnosis.notes, note), pose_errors=errors)


def columns_of(scene: Scene, poses: Poses) -> tuple[int, ...]:
    """For each object its index among the poses, or -1."""
    if not poses.names:
        if len(scene.objects) != 1:
            raise InputError(
                f"{poses.source}: names are missing and the scene has {len(scene.objects)} objects "
                f"({', '.join(scene.names)}); expected whose poses these are; add names"
            )
        return (0,)
    for name in poses.names:
        if name not in scene.names:
            raise InputError(
                f"{poses.source}: names holds {name!r}; expected objects of the scene ({', '.join(scene.names)}); rename it"
            )
    return tuple(poses.names.index(name) if name in poses.names else -1 for name in scene.names)


def check_poses(scene: Scene, poses: Poses) -> None:
    """Refuses scenes with effects, and recordings that are too short or too long.

    Raises:
      InputError: what is wrong and what to do.
    """
    if scene.effects:
        raise InputError(
            f"scene: it has an effect already ({scene.effects[0].effect}); a diagnosis starts from the base model; remove "
            "the entries of type effect"
        )
    if len(poses.time) < LEAST_TIMES:
        raise InputError(
            f"{poses.source}: time has {len(poses.time)} samples; cannot tell from fewer than {LEAST_TIMES}, since some are "
            "held out; give a longer recording"
        )
    frames = (poses.time[-1] - poses.time[0]) * rate_of(poses.time)
    if frames > MOST_FRAMES:
        raise InputError(
            f"{poses.source}: time spans {poses.time[-1] - poses.time[0]:g} s, {frames:.0f} frames of simulation at a "
            f"sample's length; expected at most {MOST_FRAMES}; give a shorter part, times in seconds"
        )


def check_motion(clip: PosesFit, poses: Poses) -> None:
    """Refuses recordings in which nothing moves.

    Raises:
      InputError: positions and orientations change by less than their noise.
    """
    m = clip.measured
    place = (np.nanmax(_known(m.moments), 0) - np.nanmin(_known(m.moments), 0)) / m.moment_noise
    turn = np.arccos(np.clip(np.abs(np.nanmin(_known(_turned(clip)), 0)), 0.0, 1.0)) * 2 / m.edge_noise
    if not max(float(place.max(initial=0.0)), float(turn.max(initial=0.0))) > LEAST_MOTION:
        raise InputError(
            f"{poses.source}: pos and quat change by less than {LEAST_MOTION:g} noise widths; cannot tell from what is at "
            "rest; record a motion"
        )


def _known(values: np.ndarray) -> np.ndarray:
    """With columns that hold no number at all set to zero, so that they span nothing."""
    return np.where(np.isfinite(values).any(0), values, 0.0)


def _turned(clip: PosesFit) -> np.ndarray:
    """Absolute scalar products of each orientation with the object's first known one, (times, objects)."""
    quaternion = clip.quaternion
    result = np.ones(quaternion.shape[:2])
    for n in range(quaternion.shape[1]):
        seen = np.isfinite(quaternion[:, n]).all(-1)
        if seen.any():
            result[seen, n] = np.abs(quaternion[seen, n] @ quaternion[seen, n][0])
    return result


def unsettled(found: Signs, compared: Compared) -> Signs:
    """The signs with leads in nats where a fit leaves less than the noise.

    A video's noise is read off its residuals; that of poses is stated, or cautious, and a lead must not count more because
    of it.
    """
    if not compared.candidates or found.lead <= compared.candidates[0].lead:
        return found
    unit = compared.candidates[0].lead / found.lead
    return dataclasses.replace(
        found,
        lead=unit * found.lead,
        margin=unit * found.margin,
        pair=unit * found.pair,
        held_out=unit * found.held_out,
    )


# --- the answer -------------------------------------------------------------------------------------------------------


def _result(
    clip: PosesFit,
    compared: Compared,
    outside: tuple[HeldOut, Errors, Errors],
    found: Signs,
    said: Answer,
    blank: Observation,
    columns: tuple[int, ...],
    seed: int,
    began: float,
) -> Diagnosis:
    base = compared.base
    scene = base.hypothesis.space.scene
    verdict, best = verdict_of(compared, said, scene.names, scene.shapes)
    shown = best.fit if best else base
    if best is not None and best is not best_candidate(compared):
        outside = held_out(clip, base, best.fit)
    if best is None:
        outside = (dataclasses.replace(outside[0], after=outside[0].before), outside[1], outside[1])
    view = view_of(clip, shown, blank, columns, hidden=False)
    maps = [misfit_map(clip, fit) for fit in (base, shown)]
    seen = seen_frames(clip)
    return Diagnosis(
        verdict=verdict,
        gap=_gap(outside, seed),
        where=places_of(maps[0], maps[1][0] if best else None, base, best.fit if best else None, view),
        candidates=tuple(ranked(clip, compared, said, outside[0], best)),
        residual=describe(clip, base, view_of(clip, base, blank, columns, hidden=False)),
        remaining=describe(clip, shown, view),
        base=base.hypothesis.scene(base.z, clip.frames),
        scene=shown.hypothesis.scene(shown.z, clip.frames),
        matching=tuple(j + 1 if j >= 0 else -1 for j in columns),
        map_before=np.where(seen, np.sqrt(maps[0][0]), np.nan),
        map_after=np.where(seen, np.sqrt(maps[1][0]), np.nan),
        channels=maps[0][1],
        notes=_notes(clip, compared, best, outside, scene.names, columns),
        signs=dataclasses.asdict(found),
        seconds=time.monotonic() - began,
        rollouts=int(clip.rollouts),
        pose_errors=_errors(clip, base, shown),
    )


def _gap(outside: tuple[HeldOut, Errors, Errors], seed: int) -> Gap:
    held, before, after = outside
    low, high = held.interval(seed)
    return Gap(
        metric="positions and rotations against the measured ones, root mean square over held-out samples, in widths of "
        "the noise",
        held_out="every third block of three samples, at least a tenth of a second",
        before=float(np.sqrt(np.mean(held.before**2))),
        after=float(np.sqrt(np.mean(held.after**2))),
        noise_floor=held.floor,
        closed=held.closed,
        closed_low=low,
        closed_high=high,
        iou_before=math.nan,
        iou_after=math.nan,
        epe_before=math.nan,
        epe_after=math.nan,
        position_before=before.position,
        position_after=after.position,
        rotation_before=before.rotation,
        rotation_after=after.rotation,
    )


def _errors(clip: PosesFit, base: Fit, shown: Fit) -> PoseErrors:
    return PoseErrors(clip.time, *errors_of(clip, base), *errors_of(clip, shown))


def _notes(
    clip: PosesFit,
    compared: Compared,
    best: Candidate | None,
    outside: tuple[HeldOut, Errors, Errors],
    names: tuple[str, ...],
    columns: tuple[int, ...],
) -> tuple[str, ...]:
    notes = [UNCALIBRATED, noise_words(clip)]
    if best is not None:
        notes.append(f"On held-out samples the error goes from {words(outside[1])} to {words(outside[2])}.")
    else:
        notes.append(f"On held-out samples the base model errs by {words(outside[1])}.")
    lost = [n for n, j in zip(names, columns, strict=True) if j < 0]
    if lost:
        notes.append(f"No poses of {', '.join(lost)}: nothing is known of it.")
    if compared.impacts:
        notes.append(
            f"{compared.impacts} impacts may each err by 8 % of their change of velocity before anything else is blamed."
        )
    return tuple(notes)


def noise_words(clip: PosesFit) -> str:
    """How long a simulated frame is, and how noisy the measurement."""
    m = clip.measured
    source = "as stated" if m.stated else "from third differences in time; of smoothed poses that is too little"
    moved = m.moment_noise[np.isfinite(m.moments).any(0)]
    turned = m.edge_noise[np.isfinite(m.reach).any((0, 2))]
    parts = [f"positions {1e3 * np.median(moved):.2g} mm ({source})"] if moved.size else []
    parts += [f"rotations {np.degrees(np.median(turned)):.2g} degrees"] if turned.size else []
    return f"A frame is {1e3 / clip.simulator.fps:.4g} ms of simulation. Noise of {', of '.join(parts)}."


def words(errors: Errors) -> str:
    """Errors in metres and degrees."""
    parts = []
    if math.isfinite(errors.position):
        parts.append(f"{errors.position:.2g} m")
    if math.isfinite(errors.rotation):
        parts.append(f"{np.degrees(errors.rotation):.2g} degrees")
    return " and ".join(parts) or "an unknown amount"
