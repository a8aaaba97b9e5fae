"""What is seen of the objects: exact ids, fat or thin ones, hidden parts, and the border's noise."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from benchmarks.withheld.effect import Effect
from benchmarks.withheld.film import OUTLINE, Film

FINE = 2  # finer than the picture, for distances
FLIPS = 0.3


def widened(film: Film, frame: int, width: float) -> Int[np.ndarray, "height width"]:
    """A frame's ids with every object's outline moved outward by `width` pixels (inward where negative).

    By the signed distance of a finer picture; where two would overlap, the one that reaches deeper shows.
    """
    ids = film.cast(frame, FINE).ids
    out = np.zeros((film.view.height, film.view.width), np.int32)
    deepest = np.full(out.shape, -np.inf)
    for i in range(len(film.solids)):
        inside = (ids == i + 1).astype(np.uint8)
        if not inside.any():
            continue
        out_by = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        in_by = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        # Distances run from centre to centre of the fine pixels: the border lies half a one nearer.
        depth = (np.where(inside, in_by - 0.5, 0.5 - out_by)).reshape(film.view.height, FINE, film.view.width, FINE)
        depth = depth.mean((1, 3)) / FINE
        seen = (depth > -width) & (depth > deepest)
        out[seen], deepest[seen] = i + 1, depth[seen]
    return out


def noisy(ids: UInt8[np.ndarray, "height width"], rng: np.random.Generator) -> UInt8[np.ndarray, "height width"]:
    """Some pixels take a neighbour's id: a random half pixel at every border."""
    padded = np.pad(ids, 1, mode="edge")
    choice = rng.integers(0, 4, ids.shape)
    h, w = ids.shape
    around = np.stack([padded[:h, 1 : w + 1], padded[2:, 1 : w + 1], padded[1 : h + 1, :w], padded[1 : h + 1, 2:]])
    other = np.take_along_axis(around, choice[None], 0)[0]
    return np.where(rng.random(ids.shape) < FLIPS, other, ids)


def rectangle(values: dict[str, Any]) -> tuple[slice, slice]:
    """An occluder's rows and columns."""
    return (
        slice(round(values["top"]), round(values["bottom"])),
        slice(round(values["left"]), round(values["right"])),
    )


def _supports(seen: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "16"]:
    rows, columns = np.nonzero(seen)
    return (np.stack([columns, rows], -1) @ OUTLINE.T).max(0)


def shown(film: Film) -> list[list[Bool[np.ndarray, "rows columns"]]]:
    """Half-resolution masks of every frame and object, kept with the film."""
    kept = film.__dict__.get("half_masks")
    if kept is None:
        kept = []
        for frame in range(film.frames):
            ids = film.cast(frame, 0.5).ids
            kept.append([ids == i + 1 for i in range(len(film.solids))])
        film.__dict__["half_masks"] = kept
    return kept


def bitten(film: Film, effect: Effect) -> float:
    """How much of an object's extent an occluder takes away at most, pixels; -1 where little of one is left."""
    values = effect.parameters
    part = (
        slice(round(values["top"] / 2), round(values["bottom"] / 2)),
        slice(round(values["left"] / 2), round(values["right"] / 2)),
    )
    most = 0.0
    for objects in shown(film):
        for seen in objects:
            left = seen.copy()
            left[part] = False
            if left.sum() < 0.25 * seen.sum() or not seen.any():
                return 1e9
            if left.sum() < seen.sum():
                most = max(most, float((_supports(seen) - _supports(left)).max()) * 2)
    return most


def bites(film: Film, effect: Effect) -> Float[np.ndarray, "frames objects 16"]:
    """By how much an occluder shortens each object's reaches, pixels (a whole object that is hidden loses nothing)."""
    values = effect.parameters
    part = (
        slice(round(values["top"] / 2), round(values["bottom"] / 2)),
        slice(round(values["left"] / 2), round(values["right"] / 2)),
    )
    out = np.zeros((film.frames, len(film.solids), len(OUTLINE)))
    for frame, objects in enumerate(shown(film)):
        for i, seen in enumerate(objects):
            left = seen.copy()
            left[part] = False
            if left.any() and left.sum() < seen.sum():
                out[frame, i] = 2 * (_supports(seen) - _supports(left))
    return out


def hidden_frames(film: Film, effect: Effect) -> list[int]:
    """Frames in which an occluder hides part of an object."""
    values = effect.parameters
    part = (
        slice(round(values["top"] / 2), round(values["bottom"] / 2)),
        slice(round(values["left"] / 2), round(values["right"] / 2)),
    )
    return [k for k, objects in enumerate(shown(film)) if any(seen[part].any() for seen in objects)]
