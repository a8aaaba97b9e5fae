"""Does the camera move? Its motion from frame to frame, from what most of the picture does."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mjx_refine.observe.untyped import opencv

_LEAST_POINTS = 15


@dataclass(frozen=True)
class CameraMotion:
    """Motion of the background in the picture.

    Attributes:
      to_first: maps pixels of frame t to those of frame 0, affine, shape (T, 2, 3).
      steps: greatest displacement of the picture's corners from frame t to t + 1, px, shape (T-1,).
      drift: greatest displacement of the corners against frame 0, px.
      moving: whether the camera moves.
      measurable: whether the background had enough texture to tell.
    """

    to_first: Float[np.ndarray, "frames 2 3"]
    steps: Float[np.ndarray, " intervals"]
    drift: float
    moving: bool
    measurable: bool


def measure_camera(frames: UInt8[np.ndarray, "frames height width 3"]) -> CameraMotion:
    """Follows corners of the background (Shi-Tomasi, Lucas-Kanade) and fits a similarity with RANSAC.

    A camera counts as moving when its corners drift by more than 1.5 px in all and in more than a few frames;
    measurement noise alone stays well below.
    """
    greys = [cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in frames]
    height, width = greys[0].shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float).T
    identity = np.eye(3)
    to_first, steps, measured = [identity], [], 0
    for previous, current in itertools.pairwise(greys):
        step = _step(previous, current)
        measured += step is not None
        step = identity if step is None else step
        steps.append(float(np.hypot(*((step @ corners)[:2] - corners[:2])).max()))
        to_first.append(to_first[-1] @ step)
    drifts = [np.hypot(*((m @ corners)[:2] - corners[:2])).max() for m in to_first]
    measurable = measured >= 0.6 * len(steps)
    moving = measurable and max(drifts) > 1.5 and _really_moves(steps, drifts)
    return CameraMotion(
        np.stack([m[:2] for m in to_first]), np.array(steps), float(max(drifts)), bool(moving), measurable
    )


def _really_moves(steps: list[float], drifts: list[float]) -> bool:
    """Noise walks at random; a camera moves in steps of its own: several of them well above the tracker's noise."""
    return float(np.quantile(steps, 0.7)) > 0.2 or max(drifts) > 4


def _step(previous: np.ndarray, current: np.ndarray) -> Float[np.ndarray, "3 3"] | None:
    """Maps pixels of ``current`` to ``previous``, or None where too little can be followed."""
    points = _spread_corners(previous)
    if points is None or len(points) < _LEAST_POINTS:
        return None
    there, found, _ = opencv.calcOpticalFlowPyrLK(previous, current, points, None, winSize=(21, 21), maxLevel=3)
    back, found_back, _ = opencv.calcOpticalFlowPyrLK(current, previous, there, None, winSize=(21, 21), maxLevel=3)
    good: Bool[np.ndarray, " points"] = (found.ravel() > 0) & (found_back.ravel() > 0)
    good &= np.abs(points - back).reshape(-1, 2).max(-1) < 0.5
    if np.count_nonzero(good) < _LEAST_POINTS:
        return None
    cv2.setRNGSeed(0)
    fit, inliers = cv2.estimateAffinePartial2D(
        there[good].reshape(-1, 2), points[good].reshape(-1, 2), method=cv2.RANSAC, ransacReprojThreshold=0.7
    )
    if fit is None or np.count_nonzero(inliers) < max(_LEAST_POINTS, 0.4 * np.count_nonzero(good)):
        return None
    if not _everywhere(points[good].reshape(-1, 2)[inliers.ravel() > 0], previous.shape):
        return None  # one textured object, not the scene
    return np.vstack([fit, [0, 0, 1]])


def _everywhere(points: Float[np.ndarray, "points 2"], shape: tuple[int, ...]) -> bool:
    """Whether the points lie in most parts of the picture."""
    height, width = shape[:2]
    cells = {(int(4 * y / height), int(4 * x / width)) for x, y in points}
    span = np.ptp(points, axis=0) / [width, height]
    return len(cells) >= 7 and bool((span > 0.5).all())


def _spread_corners(grey: np.ndarray) -> np.ndarray | None:
    """Corners from every part of the picture, so that one textured object cannot outvote the rest."""
    height, width = grey.shape
    found = []
    for r in range(4):
        for c in range(4):
            rows = slice(r * height // 4, (r + 1) * height // 4)
            cols = slice(c * width // 4, (c + 1) * width // 4)
            points = cv2.goodFeaturesToTrack(grey[rows, cols], 12, 0.02, 5, blockSize=5)
            if points is not None:
                strength = cv2.cornerMinEigenVal(grey[rows, cols], 5)
                at = np.rint(points.reshape(-1, 2)).astype(int)
                strong = strength[at[:, 1], at[:, 0]] > 1e-4
                found.append(points.reshape(-1, 2)[strong] + [cols.start, rows.start])
    if not found:
        return None
    points = np.concatenate(found).astype(np.float32)
    edge = 4
    inside = (points > edge).all(-1) & (points[:, 0] < width - edge) & (points[:, 1] < height - edge)
    return points[inside].reshape(-1, 1, 2)
