"""Outlines of masks over pictures: observed solid and pale, simulated dashed and strong, one hue an object."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from mjx_fitness import UNMATCHED

from mjx_refine.observation import Observation
from mjx_refine.observe.preview import flow_colours
from mjx_refine.report.flow_picture import largest_flow
from mjx_refine.search.result import Replay
from mjx_refine.view.tiles import foreground

COLOURS = np.array(
    [[255, 200, 0], [0, 190, 255], [255, 70, 160], [90, 225, 70], [255, 120, 30], [165, 120, 255], [0, 225, 190]],
    np.uint8,
)
"""Of the simulated objects, in turn."""

HALO = (16, 16, 20)
LONE = (235, 235, 235)
"""Observed masks that belong to no object."""

_SHIFT = 4  # cv2 takes 1/16 px


def colour(index: int) -> tuple[int, int, int]:
    """RGB of object ``index``'s simulated outline."""
    red, green, blue = (int(c) for c in COLOURS[index % len(COLOURS)])
    return red, green, blue


def pale(index: int) -> tuple[int, int, int]:
    """RGB of the outline that was observed of object ``index``; -1 for one that is no object's."""
    if index < 0:
        return LONE
    red, green, blue = (round(0.4 * c + 0.6 * 255) for c in colour(index))
    return red, green, blue


class Overlay:
    """Draws frames with observed and simulated outlines, at one size.

    Args:
      observation: the clip; without masks its moving region is outlined.
      replay: what to draw over it.
      matching: for each object its mask's id, or ``UNMATCHED``.
      size: (width, height) of the pictures [px].
    """

    def __init__(self, observation: Observation, replay: Replay, matching: tuple[int, ...], size: tuple[int, int]):
        self.observation, self.replay, self.size = observation, replay, size
        self.seen = foreground(observation)
        self.largest = largest_flow(observation)
        ids = [int(i) for i in np.unique(self.seen) if i != 0]
        owners = {mask: k for k, mask in enumerate(matching) if mask != UNMATCHED}
        if observation.masks is None:
            owners = {}
        self.seen_colours = {i: pale(owners.get(i, -1)) for i in ids}
        self.objects = len(matching)

    def __call__(self, t: int) -> UInt8[np.ndarray, "height width 3"]:
        """Frame ``t``, RGB."""
        image = background(self.observation, t, self.size, self.largest)
        for number, shade in self.seen_colours.items():
            _outline(image, self.seen[t] == number, shade, dashed=False)
        for k in range(self.objects):
            _outline(image, self.replay.masks[t] == k + 1, colour(k), dashed=True)
        return image


def background(
    observation: Observation, t: int, size: tuple[int, int], largest: float
) -> UInt8[np.ndarray, "height width 3"]:
    """The frame, or the flow from it, dimmed, where there are no frames; ``largest`` [px] has full colour."""
    if observation.frames is not None:
        return resized(observation.frames[t], size)
    colours = flow_colours(observation.flow[min(t, observation.length - 2)], largest)
    return resized(np.rint(0.45 * colours).astype(np.uint8), size)


def resized(image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "height width 3"]:
    """The picture at another size, smooth both ways."""
    way = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_CUBIC
    return np.ascontiguousarray(cv2.resize(image, size, interpolation=way))


def fitted(image: tuple[int, int], most: int) -> tuple[int, int]:
    """(width, height) of a picture scaled so that its longer side is ``most`` [px]; even the shorter keeps 8."""
    scale = most / max(image)
    return max(8, round(image[0] * scale)), max(8, round(image[1] * scale))


def _outline(image: np.ndarray, mask: Bool[np.ndarray, "h w"], shade: tuple[int, int, int], dashed: bool) -> None:
    """Draws a mask's outline on ``image`` in place, with a dark halo, as wide as suits the picture."""
    if not mask.any():
        return
    height, width = image.shape[:2]
    weight = max(2, round(width / 320))
    for line in _lines(mask, (width, height), 5 * weight if dashed else 0):
        points = np.rint(line * (1 << _SHIFT)).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(image, [points], not dashed, HALO, weight + 2, cv2.LINE_AA, _SHIFT)
        cv2.polylines(image, [points], not dashed, shade, weight, cv2.LINE_AA, _SHIFT)


def _lines(mask: Bool[np.ndarray, "h w"], size: tuple[int, int], dash: int) -> list[Float[np.ndarray, "points 2"]]:
    """A mask's outlines at another size [px]; cut into dashes and gaps of about ``dash`` where that is not 0."""
    way = cv2.INTER_AREA if size[0] < mask.shape[1] else cv2.INTER_LINEAR
    # A border of background, so that what leaves the picture is closed at its edge.
    soft = cv2.resize(mask.astype(np.float32), size, interpolation=way)
    soft = cv2.GaussianBlur(np.pad(soft, 1), (3, 3), 0) if min(size) > 60 else np.pad(soft, 1)
    contours, _ = cv2.findContours((soft > 0.5).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    lines = [contour[:, 0].astype(np.float64) - 1 for contour in contours]
    if not dash:
        return lines
    pieces = []
    for line in lines:
        closed = np.concatenate([line, line[:1]])
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        periods = max(1, round(along[-1] / (1.8 * dash)))
        phase = along / max(along[-1], 1e-9) * periods
        pieces += [closed[(phase >= k) & (phase <= k + 0.55)] for k in range(periods)]
    return [piece for piece in pieces if len(piece)]
