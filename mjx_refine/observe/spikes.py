"""Masks that swell for a frame or two: where a reflection or a shadow touches an object, it is cut off again."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Int, UInt8
from scipy import ndimage

REACH = 4
"""Frames to each side that tell an object's usual area."""

SWELLING = 1.3
"""A mask larger than this times the usual area, before and after alike, is a spike."""


def cut_spikes(
    masks: Int[np.ndarray, "frames height width"], frames: UInt8[np.ndarray, "frames height width 3"]
) -> tuple[Int[np.ndarray, "frames height width"], int]:
    """Cuts every spike down to the neighbouring frame's outline, laid where its picture fits best.

    An object that comes nearer, or is smeared by its motion, swells for longer and is left alone.

    Returns:
      the masks and how many were cut.
    """
    result, cut = masks.copy(), 0
    for number in np.unique(masks[masks > 0]):
        area = (masks == number).sum((1, 2)).astype(float)
        for t in np.nonzero(area > 0)[0]:
            sides = [area[max(t - REACH, 0) : t], area[t + 1 : t + 1 + REACH]]
            usual = [np.median(side[side > 0]) if (side > 0).any() else np.nan for side in sides]
            known = [u for u in usual if np.isfinite(u)]
            if len(known) == 1:
                # At an end of the track growth may still go on.
                step = -1 if np.isfinite(usual[0]) else 1
                if 0 <= t + 2 * step < len(area):
                    known.append(2 * area[t + step] - area[t + 2 * step])
            if not known or area[t] < SWELLING * max(known):
                continue
            near = [s for s in range(max(t - REACH, 0), min(t + REACH + 1, len(area))) if s != t and area[s] > 0]
            near = [s for s in near if area[s] < 1.15 * max(known)]
            if not near:
                continue
            model = min(near, key=lambda s: (abs(s - t), s))
            kept = _fitted(masks[model] == number, frames[model], masks[t] == number, frames[t])
            if kept.any():
                result[t][masks[t] == number] = 0
                result[t][kept] = number
                cut += 1
    return result, cut


def _fitted(model: np.ndarray, model_picture: np.ndarray, swollen: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """The part of ``swollen`` under the model's outline, moved to where colours and mask agree best."""
    rows, columns = (np.nonzero(model.any(axis))[0] for axis in (1, 0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    template, shape = model_picture[box], model[box].astype(np.uint8)
    pad = max(shape.shape)
    wide = cv2.copyMakeBorder(picture, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    inside = cv2.copyMakeBorder(swollen.astype(np.float32), pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=0)
    count = float(shape.sum())
    colour = cv2.matchTemplate(wide, template, cv2.TM_SQDIFF, mask=np.repeat(shape[..., None], 3, 2)) / count
    covered = cv2.matchTemplate(inside, shape.astype(np.float32), cv2.TM_CCORR) / count
    # A tenth of the object outside of the mask weighs as much as colours 20 levels off.
    price = np.nan_to_num(colour, nan=np.inf, posinf=1e12) / (3 * 20.0**2) + 10.0 * (1.0 - covered)
    row, column = np.unravel_index(int(np.argmin(price)), price.shape)
    placed = np.zeros(inside.shape, bool)
    placed[row : row + shape.shape[0], column : column + shape.shape[1]] = shape > 0
    placed = ndimage.binary_dilation(placed)[pad:-pad, pad:-pad]
    return swollen & placed
