"""What a diagnosis sees of a clip, and how noisy it is."""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from mjx_refine.diagnosis.seen.before import before_others
from mjx_refine.diagnosis.seen.gaps import gap_between
from mjx_refine.diagnosis.seen.partly import half_planes, masks_within
from mjx_refine.observation import Observation
from mjx_refine.search.features import flow_points, outlines
from mjx_refine.view.moments import BESIDE, whole_masks
from mjx_refine.view.tiles import foreground

GRID = (6, 4)
"""Columns and rows of places beside the objects where the flow is looked at."""

EDGE_FLOOR, FLOW_FLOOR = 0.3, 0.15
"""Noise that is assumed at least [px]: masks are drawn in whole pixels, and no flow is better."""

MOMENT_FLOOR = 0.05
"""Noise of centroids and of the radius that a mask's area is worth, that is assumed at least [px]: pixels average over an
outline, whole ones as they are."""

FRESH, STALE = 1.0, 0.1
"""Speed from which on every frame tells something new of a mask [px/frame], and what one counts that does not move."""

FLOW_PART = 0.08
"""Error of measured flow that is smooth over an object, as a part of its motion; half where its noise is stated."""

BLURRED = 2.0
"""How far flow that was measured is thought to carry an object's motion beyond its outline [px]: flow is looked at so far inside
masks, and without this a bounce without effect (seed 12, 054) led by 72 for masks that are too fat."""


class Parts(NamedTuple):
    """One array for each kind of measurement, measured, predicted, or the difference.

    Attributes:
      reach: how far each object's mask reaches, (..., frames, objects, directions).
      flow: on the objects, (..., intervals, objects, points, 2).
      moments: centroid and equivalent radius of whole masks, (..., frames, objects, 3).
      background: flow beside the objects, (..., intervals, places, 2).
    """

    reach: Any
    flow: Any
    moments: Any
    background: Any

    def flat(self) -> np.ndarray:
        """All in one row for each entry of the leading axis."""
        return np.concatenate([part.reshape(len(part), -1) for part in self], 1)

    def beside(self, others: Parts) -> Parts:
        """These rows, and then others."""
        return Parts(*(np.concatenate(both) for both in zip(self, others, strict=True)))


@dataclasses.dataclass(frozen=True)
class Measured:
    """Of one clip with N objects.

    Attributes:
      reach: how far each object's mask reaches [px]; NaN where that is not known.
      moments: of each mask that is seen whole, or of what of it lies within its half plane: its centroid and the radius of a
        disc as large [px]; NaN elsewhere.
      pixels: points of each mask.
      flow: the flow there [px/frame]; NaN where it was not measured.
      places: points of a grid over the picture [px].
      background: flow there [px/frame], NaN on and near objects.
      present: whether the object has a mask.
      edge_noise: of ``reach``, by object [px].
      flow_noise: of ``flow``, by object [px].
      moment_noise: of ``moments``, by object [px].
      background_noise: of ``background`` [px].
      stated: whether the clip says how noisy its flow is.
      drawn: whether the flow was measured, and so drawn along by outlines: its noise is not stated, or by pixel, as only a
        measurement's is.
      shared: by how much centroid and equivalent radius of a mask that is before another fall short, for each pixel by which
        masks are too fat [px/px]; None: by nothing.
      planes: (normal x, normal y, offset) [px] of the half plane n . p <= o within which a mask is its object's whole
        silhouette; NaN where the mask is that itself, and where nothing is known; None: nowhere.
    """

    reach: Float[np.ndarray, "frames objects directions"]
    moments: Float[np.ndarray, "frames objects 3"]
    pixels: Float[np.ndarray, "frames objects points 2"]
    flow: Float[np.ndarray, "intervals objects points 2"]
    places: Float[np.ndarray, "places 2"]
    background: Float[np.ndarray, "intervals places 2"]
    present: np.ndarray
    edge_noise: Float[np.ndarray, "objects"]
    flow_noise: Float[np.ndarray, "objects"]
    moment_noise: Float[np.ndarray, "objects 3"]
    background_noise: float
    stated: bool
    drawn: bool = False
    shared: Float[np.ndarray, "frames objects 3"] | None = None
    planes: Float[np.ndarray, "frames objects 3"] | None = None

    @property
    def whole(self) -> Float[np.ndarray, "frames objects 3"]:
        """``moments`` of masks that are seen whole alone."""
        return self.moments if self.planes is None else np.where(np.isfinite(self.planes), np.nan, self.moments)

    @functools.cached_property
    def freshness(self) -> Float[np.ndarray, "frames objects"]:
        """How much of a new measurement each mask is: the same pixels say the same while nothing moves by one."""
        speed = np.full(self.present.shape, np.nan)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            speed[:-1] = np.nanmedian(np.linalg.norm(self.flow, axis=-1), -1)
        speed[-1] = speed[-2] if len(speed) > 1 else np.nan
        return np.clip(np.nan_to_num(speed, nan=1.0) / FRESH, STALE, 1.0)

    @property
    def blur(self) -> float:
        """How far from an outline the flow beside it is still much like the object's [px]."""
        return 0.0 if self.stated else BLURRED

    @property
    def parts(self) -> Parts:
        """All that predictions are compared with."""
        return Parts(self.reach, self.flow, self.moments, self.background)

    @functools.cached_property
    def objects(self) -> Int[np.ndarray, "residuals"]:
        """Which object each number of ``Parts.flat`` is of; one past the last: the background."""
        count = self.reach.shape[1]
        numbers = np.arange(count)
        told = [
            np.broadcast_to(numbers.reshape((1, -1) + (1,) * (p.ndim - 2)), p.shape).ravel() for p in self.parts[:3]
        ]
        return np.concatenate([*told, np.full(self.background.size, count)])

    @property
    def count(self) -> int:
        """How many numbers are known of outlines and whole masks."""
        return int(np.isfinite(self.reach).sum() + np.isfinite(self.moments).sum())

    def without_what_lacks(self, told: Measured) -> Measured:
        """The same, but for outlines and whole masks of which ``told`` knows nothing."""
        reach = np.where(np.isnan(told.reach), np.nan, self.reach)
        return dataclasses.replace(self, reach=reach, moments=np.where(np.isnan(told.whole), np.nan, self.moments))

    def kept(self, keep: Bool[np.ndarray, "frames"]) -> Bool[np.ndarray, "residuals"]:
        """Which numbers of ``Parts.flat`` belong to kept frames."""
        both = keep[:-1] & keep[1:]
        parts = [(keep, self.reach), (both, self.flow), (keep, self.moments), (both, self.background)]
        return np.concatenate([np.repeat(held, array[0].size) for held, array in parts])

    def split(self, row: Float[np.ndarray, "residuals"]) -> Parts:
        """A row of ``Parts.flat`` in its parts again; what comes after them is left out."""
        ends = np.cumsum([part.size for part in self.parts])
        pieces = np.split(row, ends)[:-1]
        return Parts(*(piece.reshape(part.shape) for piece, part in zip(pieces, self.parts, strict=True)))


def measure(observation: Observation, columns: tuple[int, ...], near: int = 0) -> Measured:
    """Measures a clip.

    Args:
      observation: the clip.
      columns: for each object the position of its id among the masks' ids, or -1.
      near: how near the border or another mask may cut an outline, at least [px].
    """
    masks = foreground(observation)
    near = max(near, BESIDE + math.ceil(gap_between(masks)))
    seen = outlines(masks, near=near)
    pixels, flow = flow_points(masks, observation.flow, seen.ids)
    chosen, lost = [max(j, 0) for j in columns], np.array([j < 0 for j in columns])
    reach = np.where(lost[None, :, None], np.nan, seen.support[:, chosen])
    flow = np.where(lost[None, :, None, None], np.nan, flow[:-1, chosen])
    before = before_others(masks, seen.ids, near)
    whole = np.where(lost[None, :, None], np.nan, whole_masks(masks, seen.ids, near, before.whole)[:, chosen])
    planes = half_planes(masks, seen.ids, near, before)
    parts = np.where(lost[None, :, None], np.nan, masks_within(masks, seen.ids, planes)[:, chosen])
    places, background = _beside(masks, observation.flow)
    sigma = observation.flow_sigma
    given = float(np.nanmedian(sigma)) if sigma is not None else 0.0
    present = np.isfinite(seen.centre[:, chosen, 0]) & ~lost
    return Measured(
        reach=reach,
        moments=np.where(np.isnan(whole), parts, whole),
        pixels=pixels[:, chosen],
        flow=flow,
        places=places,
        background=background,
        present=present,
        edge_noise=np.maximum(_roughness(reach), EDGE_FLOOR),
        flow_noise=_flow_noise(pixels[:-1, chosen], flow, given),
        moment_noise=moment_roughness(whole),
        background_noise=max(1.5 * _spread(background), given / 3, 0.05),
        stated=sigma is not None,
        drawn=sigma is None or np.ndim(sigma) > 0,
        shared=before.shared[:, chosen],
        planes=planes[:, chosen],
    )


def moment_roughness(moments: Float[np.ndarray, "frames objects 3"]) -> Float[np.ndarray, "objects 3"]:
    """Noise of centroids and equivalent radii, from their third differences in time [px]."""
    return np.stack([np.maximum(_roughness(moments[..., k : k + 1]), MOMENT_FLOOR) for k in range(3)], -1)


def _roughness(reach: Float[np.ndarray, "frames objects directions"]) -> Float[np.ndarray, "objects"]:
    """Noise of outlines and moments from third differences in time, which no steady acceleration changes [px]."""
    if len(reach) < 6:
        return np.zeros(reach.shape[1])
    third = np.abs(np.diff(reach, 3, axis=0)) / np.sqrt(20.0)
    return np.array([1.4826 * _median(third[:, n]) for n in range(reach.shape[1])])


def _median(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else 0.0


def _incoherence(pixels: np.ndarray, flow: np.ndarray) -> Float[np.ndarray, "objects"]:
    """Noise of the flow: what an affine motion inside a mask leaves of it [px]."""
    result = np.zeros(flow.shape[1])
    for n in range(flow.shape[1]):
        left = []
        for at, moved in zip(pixels[:, n], flow[:, n], strict=True):
            if not np.isfinite(moved).all():
                continue
            design = np.concatenate([np.ones((len(at), 1)), at - at.mean(0)], 1)
            fitted = np.linalg.lstsq(design, moved, rcond=None)[0]
            left.append(np.abs(moved - design @ fitted) * np.sqrt(len(at) / (len(at) - 3)))
        result[n] = 1.4826 * _median(np.array(left)) if left else 0.0
    return result


def _flow_noise(pixels: np.ndarray, flow: np.ndarray, given: float) -> Float[np.ndarray, "objects"]:
    """Noise of the flow by object [px]: incoherence and, since flow errs smoothly too, a part of the motion itself."""
    speed = np.linalg.norm(flow, axis=-1)
    typical = np.array([_median(speed[:, n]) for n in range(flow.shape[1])])
    incoherent = np.maximum(_incoherence(pixels, flow), max(given, FLOW_FLOOR))
    return np.hypot(incoherent, (0.5 if given else 1.0) * FLOW_PART * typical)


def _beside(masks: Int[np.ndarray, "frames height width"], flow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of a grid and the median flow around each, where no object is near."""
    height, width = masks.shape[1:]
    x = (np.arange(GRID[0]) + 0.5) * width / GRID[0]
    y = (np.arange(GRID[1]) + 0.5) * height / GRID[1]
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    half = max(2, min(width, height) // 24)
    result = np.full((len(flow), len(places), 2), np.nan)
    for t in range(len(flow)):
        near = np.asarray(ndimage.binary_dilation((masks[t] > 0) | (masks[t + 1] > 0), iterations=max(6, half)), bool)
        for k, (cx, cy) in enumerate(places):
            window = np.s_[max(int(cy) - half, 0) : int(cy) + half + 1, max(int(cx) - half, 0) : int(cx) + half + 1]
            values = flow[t][window][~near[window]]
            values = values[np.isfinite(values).all(-1)]
            if len(values) > half * half:
                result[t, k] = np.median(values, axis=0)
    return places, result


def _spread(background: np.ndarray) -> float:
    """Noise of the background's flow: how far places are from the picture's common motion [px]."""
    if not np.isfinite(background).any():
        return 1.0
    common = np.array([[_median(background[t, :, k]) for k in range(2)] for t in range(len(background))])
    return 1.4826 * _median(np.abs(background - common[:, None]))
