"""The score of a clip from sums over pixels, so that a fused kernel and a plain one share one definition."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Weights:
    """fitness = iou * IoU + instance * mean instance IoU - epe * EPE - object_epe * object EPE.

    The default is the published objective, IoU - EPE (Δynamics, CVPR 2026), with the end-point error in pixels over the
    whole frame.

    Attributes:
      iou: of the foreground IoU.
      epe: of the end-point error over the frame [1/px].
      instance: of the matched instance IoU, its mean over objects.
      object_epe: of the end-point error over observed objects [1/px].
    """

    iou: float = 1.0
    epe: float = 1.0
    instance: float = 0.0
    object_epe: float = 0.0

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not np.isfinite(value) or value < 0:
                raise ValueError(f"Weights.{field.name} = {value!r}; expected a finite number >= 0")


@dataclasses.dataclass(frozen=True)
class Sums:
    """Sums over the pixels of each frame; B candidates, T frames, N objects. The unit of a sum is a pixel.

    Attributes:
      intersection: pixels in the foreground of both.
      union: pixels in the foreground of either.
      object_intersection: pixels of object n and of the mask matched to it.
      object_union: pixels of either.
      error: end-point error summed over measured pixels [px].
      measured: measured pixels.
      object_error: the same over observed foreground [px].
      object_measured: measured pixels in the observed foreground.
    """

    intersection: Float[np.ndarray, "batch frames"]
    union: Float[np.ndarray, "batch frames"]
    object_intersection: Float[np.ndarray, "batch frames objects"]
    object_union: Float[np.ndarray, "batch frames objects"]
    error: Float[np.ndarray, "batch intervals"]
    measured: Float[np.ndarray, "batch intervals"]
    object_error: Float[np.ndarray, "batch intervals"]
    object_measured: Float[np.ndarray, "batch intervals"]


@dataclasses.dataclass(frozen=True)
class Scores:
    """Scores of B candidates.

    Attributes:
      frame_iou: foreground IoU of each frame; NaN where both are empty.
      frame_epe: end-point error of each interval over the frame [px]; NaN where nothing was measured.
      object_iou: IoU of each object with its mask over the whole clip; NaN where both are empty throughout.
      iou: mean over frames of the foreground IoU.
      first_frame_iou: that of the first frame.
      epe: end-point error over all measured pixels of all intervals [px].
      first_frame_epe: that of the first interval [px].
      object_epe: end-point error over observed objects [px].
      fitness: what the search maximises.
    """

    frame_iou: Float[np.ndarray, "batch frames"]
    frame_epe: Float[np.ndarray, "batch intervals"]
    object_iou: Float[np.ndarray, "batch objects"]
    iou: Float[np.ndarray, "batch"]
    first_frame_iou: Float[np.ndarray, "batch"]
    epe: Float[np.ndarray, "batch"]
    first_frame_epe: Float[np.ndarray, "batch"]
    object_epe: Float[np.ndarray, "batch"]
    fitness: Float[np.ndarray, "batch"]

    def candidate(self, row: int) -> Scores:
        """The scores of one candidate, as a batch of one."""
        return Scores(**{f.name: getattr(self, f.name)[row : row + 1] for f in dataclasses.fields(self)})


def _ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(denominator > 0, numerator / np.where(denominator > 0, denominator, 1), np.nan)


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis without NaN; NaN where all are."""
    valid = np.isfinite(values)
    return _ratio(np.where(valid, values, 0.0).sum(-1), valid.sum(-1))


def scores_from_sums(sums: Sums, weights: Weights | None = None) -> Scores:
    """Scores of every candidate.

    A frame in which neither picture has foreground says nothing and is left out of the mean; so is an interval without
    measured flow. A clip without any measured flow has EPE 0, one without any foreground IoU 0.
    """
    weights = weights or Weights()
    frame_iou = _ratio(sums.intersection, sums.union)
    frame_epe = _ratio(sums.error, sums.measured)
    object_iou = _ratio(sums.object_intersection.sum(1), sums.object_union.sum(1))
    iou = np.nan_to_num(_mean(frame_iou))
    epe = np.nan_to_num(_ratio(sums.error.sum(-1), sums.measured.sum(-1)))
    object_epe = np.nan_to_num(_ratio(sums.object_error.sum(-1), sums.object_measured.sum(-1)))
    fitness = weights.iou * iou - weights.epe * epe - weights.object_epe * object_epe
    if weights.instance:
        fitness = fitness + weights.instance * np.nan_to_num(_mean(object_iou))
    return Scores(
        frame_iou=frame_iou,
        frame_epe=frame_epe,
        object_iou=object_iou,
        iou=iou,
        first_frame_iou=np.nan_to_num(frame_iou[..., 0]),
        epe=epe,
        first_frame_epe=np.nan_to_num(frame_epe[..., 0]),
        object_epe=object_epe,
        fitness=fitness,
    )
