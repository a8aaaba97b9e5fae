"""What an answer is read from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from mjx_refine.diagnosis.fits.candidates import LEAST_UNIT, Candidate, Compared
from mjx_refine.diagnosis.fits.fit import ClipFit
from mjx_refine.diagnosis.misfit.where import background_energy, misfit_map
from mjx_refine.effects import acting_kind

INIMITABLE = ("camera_motion", "camera_shake", "lens_distortion", "rolling_shutter")
"""Effects that contacts which err do not imitate."""

PLIANT = ("push", "offset_com")
"""Effects that bend to many others, since a kick at any moment and a mass anywhere leave little that they cannot roughly do."""

UNMISTAKABLE, BY_FAR = ("dropped_frames", "mask_bias", "occluder"), 100.0
"""Effects that nothing else looks like, and the margin from which they are named whatever they leave: on seeds 10 to 14 of the
withheld exams one of these led every other by so much on 36 clips, and was at work on all of them, alone on 27; six of these
had been ``unknown``, since masks that are too thin, what stands before objects, and frames around a gap leave more than noise."""

TILTS = ("camera_roll", "slope")
"""Effects that tilt the world, which velocities, poses and the camera's height imitate so well that little of the gap is left to
be closed."""

MOSTLY = 0.6
"""Part of the time on the floor from which a force of any course counts as one of an object on the floor."""

MOVES_CAMERA = ("camera_motion", "camera_shake")
"""Effects that the background shows, whatever objects do: one of these and another are named with less of a lead, too."""

STILL = 0.6
"""Mean square of what the background's flow leaves in common [noise widths squared] above which the camera does something that
has not been named. Of 52 clips of seed 17 of the withheld exams whose camera stands, half of them with measured flow, none
leaves 0.01; a camera that moves by 6 px leaves 1.7; of seven real clips from a tripod five leave 0.1 to 0.5."""


@dataclasses.dataclass(frozen=True)
class Signs:
    """What the answer is read from; leads are of evidence, in units of the misfit that the best hypothesis leaves.

    Attributes:
      lead: of the best single effect over the base model.
      margin: over the best effect of another name.
      pair: of the best two effects over the best single one.
      before: mean square residual of the base model, noise widths squared.
      after: ditto of the best hypothesis.
      structure_before: how smooth in time the base model's residuals are; 1: not at all.
      structure_after: ditto of the best hypothesis'.
      held_out: gain on held-out frames of the best hypothesis over the base model, in the same units.
      whole: mean square residual of the base model, background included.
      closed: part of the gap on held-out frames, all flow in it, that the best hypothesis closes; 1 where that is not asked.
      structure_first: ``structure_after`` of the best single effect.
      beside: 1 where one of the best two effects moves the camera, which the background shows, and the other does not, nor
        widens masks, as a camera that is not quite right seems to.
      forces: 1 where both of the best two effects move the objects.
      inimitable: 1 where the best single effect is one that contacts which err do not imitate.
      unmistakable: 1 where the best single effect is one that nothing else looks like, and leads every other by far.
      pliant: 1 where the best single effect is one that bends to many others.
      tilted: 1 where the best single effect is one that tilts the world.
      touched: 1 where the best single effect strikes: it is of a thing that nobody sees, whose form is its own.
      unnamed: gain in evidence of a force of any course over the best hypothesis; 0 where that was not asked.
      aloft: 1 where that force's object is in the air for most of the time.
      background: mean square residual of the background's flow that the best hypothesis leaves, noise widths squared.
      drawn: 1 where the flow was measured, and what outlines do to it is allowed for.
    """

    lead: float
    margin: float
    pair: float
    before: float
    after: float
    structure_before: float
    structure_after: float
    held_out: float
    whole: float
    closed: float = 1.0
    structure_first: float = 0.0
    beside: float = 0.0
    inimitable: float = 0.0
    unmistakable: float = 0.0
    pliant: float = 0.0
    unnamed: float = 0.0
    aloft: float = 0.0
    background: float = 0.0
    drawn: float = 0.0
    forces: float = 0.0
    tilted: float = 0.0
    touched: float = 0.0


def signs(clip: ClipFit, compared: Compared, held_out: float, closed: float = 1.0) -> Signs:
    """Reads the signs off all fits."""
    singles, pairs, freed = compared.candidates, compared.pairs, compared.freed
    best = best_candidate(compared)
    left = min([clip.misfit(compared.base)] + [clip.misfit(c.fit) for c in (*singles[:3], *pairs[:1])])
    unit = max(left, LEAST_UNIT)
    first = singles[0] if singles else None
    other = next((c for c in singles if first is not None and c.names != first.names), None)
    after = best.fit if best is not None else compared.base
    margin = (first.lead - max(other.lead, 0.0) if other else first.lead) / unit if first else 0.0
    return Signs(
        lead=first.lead / unit if first else 0.0,
        margin=margin,
        pair=(pairs[0].lead - singles[0].lead) / unit if pairs and singles else 0.0,
        before=clip.misfit(compared.base),
        after=clip.misfit(after),
        structure_before=structure(clip, compared.base),
        structure_after=structure(clip, after),
        held_out=held_out / unit,
        whole=2 * compared.base.data / clip.expected(),
        closed=closed,
        structure_first=structure(clip, first.fit) if first else 0.0,
        inimitable=float(bool(first) and first.names[0] in INIMITABLE),
        unmistakable=float(first is not None and first.names[0] in UNMISTAKABLE and margin > BY_FAR),
        pliant=float(first is not None and first.names[0] in PLIANT),
        tilted=float(bool(first) and first.names[0] in TILTS),
        touched=float(bool(first) and acting_kind(first.names[0]).strikes),
        unnamed=(freed.fit.evidence - after.evidence) / unit if freed else 0.0,
        aloft=float(freed is not None and freed.on_floor < MOSTLY),
        background=unsteadiness(clip, after),
        drawn=float(clip.measured.drawn),
        forces=float(bool(pairs) and all(t.kind.physical for t in pairs[0].fit.hypothesis.terms)),
        beside=float(bool(pairs) and _beside([t.name for t in pairs[0].fit.hypothesis.terms])),
    )


def _beside(names: Sequence[str]) -> bool:
    """Whether one of two effects moves the camera and the other does something else than to widen masks."""
    return len({name in MOVES_CAMERA for name in names}) == 2 and "mask_bias" not in names


def best_candidate(compared: Compared) -> Candidate | None:
    """The best of singles and pairs, or None where nothing leads the base model."""
    found = [c for c in (*compared.candidates[:1], *compared.pairs[:1]) if c.lead > 0]
    return max(found, key=lambda c: c.lead) if found else None


def unsteadiness(clip: ClipFit, fit) -> float:
    """Mean square of what the background's flow leaves in common [noise widths squared]."""
    return float(background_energy(clip, fit).mean())


def structure(clip: ClipFit, fit) -> float:
    """Energy of the residuals' running means over five frames, against what white noise of the same differences has.

    Centroids where a mask is seen whole, else how far it reaches: that errs smoothly by itself, as pixels pass by.
    """
    parts = clip.measured.split(fit.residual)
    ratios = []
    for n in range(parts.reach.shape[1]):
        ratio = _persistence(parts.moments[:, n], np.isfinite(clip.measured.moments[:, n]))
        if not np.isfinite(ratio):
            ratio = _persistence(parts.reach[:, n], np.isfinite(clip.measured.reach[:, n]))
        ratios.append(ratio)
    return float(np.nan_to_num(np.nanmean(ratios), nan=1.0)) if np.isfinite(ratios).any() else 1.0


def _persistence(residual: np.ndarray, seen: np.ndarray) -> float:
    """What ``structure`` says of one object; NaN where too little of it is seen."""
    series = np.where(seen, residual, np.nan)
    if len(series) < 7:
        return np.nan
    means = np.mean([series[k : len(series) - 4 + k] for k in range(5)], 0)
    steps = np.diff(series, axis=0)
    if np.isfinite(means).sum() < 6:
        return np.nan
    return float(5 * np.nanmean(means**2) / max(float(np.nanmean(steps**2)) / 2, 1.0))


def map_of(clip: ClipFit, fit) -> np.ndarray:
    """Root mean square misfit by object and frame [noise widths]."""
    return np.sqrt(misfit_map(clip, fit)[0])
