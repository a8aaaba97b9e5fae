"""``overlay.gif``: the clip with observed and simulated outlines."""

from __future__ import annotations

import io

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from mjx_refine.observation import Observation
from mjx_refine.report.contours import HALO, LONE, Overlay, colour, fitted, pale
from mjx_refine.search.result import Replay

LONGEST_SIDE = 480
MOST_FRAMES = 300
_DELAYS = (30, 500)
"""Shortest and longest time of a frame [ms]: viewers slow shorter ones down."""

_HOLD = 900
"""Time of the last frame [ms], so that an eye finds the beginning."""

_BAR = (245, 245, 245)
_REST = (90, 90, 96)


def overlay_gif(
    observation: Observation, replay: Replay, matching: tuple[int, ...], longest_side: int = LONGEST_SIDE
) -> bytes:
    """The animation, endless, one picture a frame (every n-th of a clip of more than 300).

    It plays at the clip's rate where that lies between 2 and 33 frames a second, else at the nearer end.

    Args:
      observation: the clip.
      replay: what is drawn over it.
      matching: for each object its mask's id, or -1.
      longest_side: of the picture [px].
    """
    size = fitted(observation.size, longest_side)
    overlay = Overlay(observation, replay, matching, size)
    stride = -(-observation.length // MOST_FRAMES)
    times = range(0, observation.length, stride)
    images = [_labelled(overlay(t), t, observation.length) for t in times]
    palette = _palette(images, len(matching))
    frames = [Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    shortest, longest = _DELAYS
    delay = int(np.clip(10 * round(100 * stride / observation.fps), shortest, longest))
    delays = [delay] * (len(frames) - 1) + [max(delay, _HOLD)]
    stream = io.BytesIO()
    frames[0].save(
        stream, "GIF", save_all=True, append_images=frames[1:], duration=delays, loop=0, optimize=True, disposal=1
    )
    return stream.getvalue()


def _labelled(image: UInt8[np.ndarray, "height width 3"], t: int, count: int) -> UInt8[np.ndarray, "height width 3"]:
    """With the frame's number and a bar of progress, so that no two pictures are equal (a GIF would merge them)."""
    height, width = image.shape[:2]
    bar = max(2, height // 100)
    image[-bar:] = _REST
    image[-bar:, : max(1, round(width * (t + 1) / count))] = _BAR
    text = f"frame {t}"
    (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
    image[height - bar - high - 10 : height - bar, : wide + 10] = HALO
    cv2.putText(image, text, (5, height - bar - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _BAR, 1, cv2.LINE_AA)
    return image


def _palette(images: list[np.ndarray], objects: int) -> Image.Image:
    """One palette for all frames: what the pictures hold, and the outlines' colours exactly."""
    shown = range(min(objects, 7))
    exact = [HALO, LONE, _BAR, _REST, *map(colour, shown), *map(pale, shown)]
    picks = np.unique(np.linspace(0, len(images) - 1, min(len(images), 8)).astype(int))
    sheet = Image.fromarray(np.concatenate([images[i] for i in picks]))
    learnt = sheet.quantize(256 - len(exact), method=Image.Quantize.MEDIANCUT).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*(c for shade in exact for c in shade), *learnt[: 3 * (256 - len(exact))]])
    return palette
