"""What a diagnosis says."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from mjx_refine.scene import Scene

NONE: tuple[str, ...] = ()
UNKNOWN = ("unknown",)


@dataclasses.dataclass(frozen=True)
class Value:
    """One fitted parameter of an effect with its 90 % interval."""

    value: float
    low: float
    high: float
    unit: str


@dataclasses.dataclass(frozen=True)
class Place:
    """Where simulation and clip part.

    Attributes:
      object: its name, or None (camera, timing).
      frames: first and last.
      phase: ``flight, impact, sliding, rolling, rest, whole``.
      channel: ``motion, rotation, shape, camera, timing, perception``.
      share: of the misfit above the noise.
      clip: of several clips, which one (its number); otherwise None.
    """

    object: str | None
    frames: tuple[int, int]
    phase: str
    channel: str
    share: float
    clip: int | None = None


@dataclasses.dataclass(frozen=True)
class Gap:
    """How far simulation and clip are apart on frames that no fit has seen.

    Attributes:
      metric: what ``before``, ``after`` and ``noise_floor`` are.
      held_out: which frames.
      before: of the base model, refitted.
      after: with the verdict's effects.
      noise_floor: what the measurement's noise alone gives.
      closed: (before - after) / (before - noise_floor).
      closed_low, closed_high: its 90 % bootstrap interval.
      iou_before, iou_after, epe_before, epe_after: full-resolution scores of the whole clip; NaN without pictures.
      position_before, position_after: where poses were measured, root mean square errors of positions on held-out samples
        [m]; otherwise NaN.
      rotation_before, rotation_after: ditto of rotations [rad].
    """

    metric: str
    held_out: str
    before: float
    after: float
    noise_floor: float
    closed: float
    closed_low: float
    closed_high: float
    iou_before: float
    iou_after: float
    epe_before: float
    epe_after: float
    position_before: float = math.nan
    position_after: float = math.nan
    rotation_before: float = math.nan
    rotation_after: float = math.nan


@dataclasses.dataclass(frozen=True)
class Ranked:
    """One candidate effect.

    Attributes:
      effect: its name.
      target: the object's name, or None.
      probability: that it is at work.
      evidence: over the base model's, natural logarithms.
      parameters: fitted values.
      gap_after: as ``Gap.after`` (by the fit of all frames, where it was not held out).
      closed: as ``Gap.closed``.
      sentence: what it says.
    """

    effect: str
    target: str | None
    probability: float
    evidence: float
    parameters: dict[str, Value]
    gap_after: float
    closed: float
    sentence: str


@dataclasses.dataclass(frozen=True)
class Verdict:
    """The answer.

    Attributes:
      effects: names; empty: nothing is missing; ``("unknown",)``: something that the catalogue does not hold.
      probability: that this answer is right.
      indistinguishable: groups of effects that this clip cannot tell apart.
      sentence: the answer in words.
      experiment: what to film next.
    """

    effects: tuple[str, ...]
    probability: float
    indistinguishable: tuple[tuple[str, ...], ...]
    sentence: str
    experiment: str


@dataclasses.dataclass(frozen=True)
class PoseErrors:
    """How far measured poses are from the simulated ones; NaN where not measured.

    Attributes:
      time: since the first sample [s].
      position: of the base model, refitted [m].
      rotation: ditto [rad].
      position_after: of the diagnosed scene [m].
      rotation_after: ditto [rad].
      plain: root mean square errors [m], [rad] of the base model's fit in which contacts may not err.
    """

    time: Float[np.ndarray, "times"]
    position: Float[np.ndarray, "times objects"]
    rotation: Float[np.ndarray, "times objects"]
    position_after: Float[np.ndarray, "times objects"]
    rotation_after: Float[np.ndarray, "times objects"]
    plain: tuple[float, float] = (math.nan, math.nan)


@dataclasses.dataclass(frozen=True)
class ClipGap:
    """One of several clips of a set-up.

    Attributes:
      source: where it came from.
      fitted: whether it was fitted; otherwise it was held out and judged, from a part of its time on.
      before: root mean square error of the base model [noise widths]; of a fitted clip over all that was fitted.
      after: ditto with the verdict's effects.
      noise_floor: as ``Gap.noise_floor``; NaN for a fitted clip.
      gain: of a held-out clip's likelihood by the verdict's effects, or else by the best candidate's [natural logarithms];
        NaN for a fitted clip.
      position_before, position_after: where poses were measured, root mean square errors of positions [m]; otherwise NaN.
      rotation_before, rotation_after: ditto of rotations [rad].
    """

    source: str
    fitted: bool
    before: float
    after: float
    noise_floor: float = math.nan
    gain: float = math.nan
    position_before: float = math.nan
    position_after: float = math.nan
    rotation_before: float = math.nan
    rotation_after: float = math.nan


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """All that a diagnosis found.

    Attributes:
      verdict: the answer.
      gap: how far it closes the gap.
      where: the places of the gap.
      candidates: effects, the likeliest first.
      residual: what the gap looks like, in words.
      remaining: what is left after the verdict's effects, in words.
      base: the base model's refit.
      scene: the diagnosed scene, with its effects as entries.
      matching: mask id of each object, or -1.
      map_before: root mean square misfit in noise widths.
      map_after: ditto with the verdict's effects.
      channels: channel of each object's and frame's misfit, index into ``CHANNELS``.
      notes: what a reader should know.
      signs: the numbers that the probabilities were read from.
      seconds: how long it took.
      rollouts: how many were simulated.
      pose_errors: where poses were measured, not pictures.
      clips: of several clips, each; scenes, maps and pose errors are then those of the first.
    """

    verdict: Verdict
    gap: Gap
    where: tuple[Place, ...]
    candidates: tuple[Ranked, ...]
    residual: str
    remaining: str
    base: Scene
    scene: Scene
    matching: tuple[int, ...]
    map_before: Float[np.ndarray, "objects frames"]
    map_after: Float[np.ndarray, "objects frames"]
    channels: np.ndarray
    notes: tuple[str, ...]
    signs: dict[str, float]
    seconds: float
    rollouts: int
    pose_errors: PoseErrors | None = None
    clips: tuple[ClipGap, ...] = ()

    @property
    def added(self) -> list[str]:
        """Names of the effects that the diagnosed scene has, and the base model's has not."""
        return [effect.effect for effect in self.scene.effects if effect not in self.base.effects]

    @property
    def places(self) -> list[Place]:
        """``where``, the largest share first."""
        return sorted(self.where, key=lambda place: -place.share)


CHANNELS = ("motion", "rotation", "shape", "camera", "timing", "perception")
