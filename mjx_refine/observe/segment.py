"""Instance masks of the moving objects of a clip."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from mjx_refine.observe.background import Background, find_motion, learn_background
from mjx_refine.observe.camera import CameraMotion
from mjx_refine.observe.foreground import Change, convex_fill, convex_hull, find_blobs, measure_change
from mjx_refine.observe.selection import select_objects
from mjx_refine.observe.tracking import Track, track_blobs
from mjx_refine.observe.video import Clip

_MOST_CANVAS = 4.0  # times the picture's area


@dataclass(frozen=True)
class Segmentation:
    """Masks with ids 1, 2, … (most prominent object first), and what was left out."""

    masks: Int[np.ndarray, "frames height width"]
    warnings: tuple[str, ...]
    pixel_noise: float


def segment(clip: Clip, camera: CameraMotion, progress: Callable[[float], object] = lambda share: None) -> Segmentation:
    """Segments and tracks what moves against the background.

    Args:
      clip: the kept frames and their context.
      camera: its motion; when it moves the background is a mosaic of the kept frames.
      progress: called with the share done.
    """
    shape = clip.frames.shape[1:3]
    background_at, noise = _backgrounds(clip, camera)

    @lru_cache(maxsize=2)
    def change_at(t: int) -> Change:
        return measure_change(clip.frames[t], *background_at(t))

    progress(0.3)
    least = max(8, int(1.0e-4 * shape[0] * shape[1]))
    blobs = []
    for t in range(len(clip.frames)):
        blobs.append(find_blobs(change_at(t), least))
        progress(0.3 + 0.6 * (t + 1) / len(clip.frames))
    tracks = track_blobs(blobs, shape, change_at)
    objects, warnings = select_objects(tracks, clip.frames)
    return Segmentation(_paint(objects, len(clip.frames), shape), tuple(warnings), noise)


def _paint(objects: list[Track], frames: int, shape: tuple[int, int]) -> Int[np.ndarray, "frames height width"]:
    masks = np.zeros((frames, *shape), np.int32)
    convex = [_is_convex(k) for k in objects]
    for t in range(frames):
        own = np.zeros(shape, np.int32)
        for number, track in reversed(list(enumerate(objects, start=1))):
            if t in track.blobs:
                own[track.blobs[t].paint(shape)] = number
        masks[t] = own
        for number, (track, filled) in enumerate(zip(objects, convex, strict=True), start=1):
            if filled and t in track.blobs:
                whole = convex_fill(track.blobs[t].paint(shape))
                masks[t][whole & (own == 0)] = number
    return masks


def _is_convex(track: Track) -> bool:
    """Whether the object fills most of its convex hull in most frames."""
    shares = [b.area / max(1, np.count_nonzero(convex_hull(b.crop))) for b in track.blobs.values()]
    return float(np.median(shares)) > 0.85


def _backgrounds(
    clip: Clip, camera: CameraMotion
) -> tuple[Callable[[int], tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]], float]:
    """The empty scene and its noise as each frame's camera sees it, and the noise's median."""
    if not camera.moving:
        frames = _related(clip)
        background = learn_background(frames, ~find_motion(frames))
        return lambda t: (background.image, background.noise), float(np.median(background.noise))
    return _mosaic(clip, camera)


def _related(clip: Clip) -> UInt8[np.ndarray, "frames height width 3"]:
    """Context frames of the same shot: cuts and other scenes are left out."""
    reference = np.median(clip.frames[:: max(1, len(clip.frames) // 15), ::4, ::4].astype(np.float32), axis=0)
    related = []
    for frame in clip.context:
        small = frame[::4, ::4].astype(np.float32)
        small *= np.median(reference.mean(-1) + 1) / np.median(small.mean(-1) + 1)
        if np.mean(np.abs(small - reference).max(-1) > 40) < 0.4:
            related.append(frame)
    return np.stack(related) if len(related) >= 12 else clip.frames


def _mosaic(
    clip: Clip, camera: CameraMotion
) -> tuple[Callable[[int], tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]], float]:
    height, width = clip.frames.shape[1:3]
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], float).T
    reached = np.concatenate([m @ corners for m in camera.to_first], axis=1)
    low, high = np.floor(reached.min(1)), np.ceil(reached.max(1))
    size = np.minimum(high - low, np.array([width, height]) * _MOST_CANVAS**0.5).astype(int)
    shift = np.array([[1, 0, -low[0]], [0, 1, -low[1]]])
    placed = [shift @ np.vstack([m, [0, 0, 1]]) for m in camera.to_first]
    picks = np.unique(np.linspace(0, len(clip.frames) - 1, min(len(clip.frames), 80)).astype(int))
    canvas = np.stack([cv2.warpAffine(clip.frames[t], placed[t], tuple(size)) for t in picks])
    whole = np.full((height, width), 255, np.uint8)
    whole[[0, -1]] = 0
    whole[:, [0, -1]] = 0
    valid = np.stack([cv2.warpAffine(whole, placed[t], tuple(size)) == 255 for t in picks])
    background: Background = learn_background(canvas, valid)
    rarely = valid.sum(0) < max(3, 0.15 * len(picks))

    def at(t: int) -> tuple[np.ndarray, np.ndarray]:
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        image = cv2.warpAffine(background.image, placed[t], (width, height), flags=flags)
        noise = cv2.warpAffine(background.noise, placed[t], (width, height), flags=flags)
        unknown = cv2.warpAffine(rarely.astype(np.uint8), placed[t], (width, height), flags=flags, borderValue=1)
        image[unknown > 0] = clip.frames[t][unknown > 0]  # nothing can be said there
        slope = np.abs(cv2.Laplacian(image.mean(-1), cv2.CV_32F))
        return image, noise + 0.15 * np.minimum(slope, 40)

    return at, float(np.median(background.noise))
