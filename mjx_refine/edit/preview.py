"""Before and after in one picture: objects in colour above, their flow below."""

from __future__ import annotations

import io

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from mjx_refine.observation import Observation
from mjx_refine.observe.preview import flow_colours

_COLOURS = np.array(
    [[236, 240, 244], [230, 159, 0], [0, 114, 178], [204, 121, 167], [0, 158, 115], [213, 94, 0], [86, 180, 233]],
    np.uint8,
)
"""Of the background and of objects in turn (Okabe and Ito's, which the colour-blind can tell apart)."""

_EDGE = (40, 40, 46)
_MOST_FRAMES = 300
_COLUMNS = 5
_WIDTH = 240


Names = tuple[tuple[str, ...], tuple[str, ...]]


def pictures(observation: Observation, largest: float, colours: list[int]) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Of every frame the objects, and below them the flow to the next frame (of the last frame, the flow to it).

    Args:
      observation: masks and flow.
      largest: flow with full saturation [px/frame].
      colours: for each object the number of its colour, from 0.
    """
    found = []
    palette = np.array([0, *(k % (len(_COLOURS) - 1) + 1 for k in colours)])
    for t in range(observation.length):
        masks = np.zeros(observation.size[::-1], int) if observation.masks is None else observation.masks[t]
        shown = _COLOURS[palette[masks]]
        flow = flow_colours(observation.flow[min(t, observation.length - 2)], largest)
        found.append(np.concatenate([shown, flow]))
    return found


def png_sheet(before: Observation, after: Observation, names: Names) -> bytes:
    """A PNG with some frames side by side: the two rows above are before the edit, the two below after it.

    ``names`` are the objects' before and after, so that each keeps its colour.
    """
    largest = _largest(before, after)
    picks = np.unique(np.linspace(0, before.length - 1, min(_COLUMNS, before.length)).astype(int))
    rows = []
    for name, observation, colours in zip(("before", "after"), (before, after), _colours(names), strict=True):
        shown = pictures(observation, largest, colours)
        rows.append(np.hstack([_labelled(_fitted(shown[t]), f"{name}, frame {t}") for t in picks]))
    stream = io.BytesIO()
    Image.fromarray(np.vstack(rows)).save(stream, "PNG", optimize=True)
    return stream.getvalue()


def gif_sheet(before: Observation, after: Observation, names: Names) -> bytes:
    """An endless GIF at the clip's rate (2 to 33 frames a second): before the edit on the left, after it on the right."""
    largest = _largest(before, after)
    stride = -(-before.length // _MOST_FRAMES)
    sides = [pictures(o, largest, c)[::stride] for o, c in zip((before, after), _colours(names), strict=True)]
    frames = [
        Image.fromarray(
            np.hstack([_labelled(_fitted(image, 360), f"{name}, frame {k * stride}") for name, image in
                       zip(("before", "after"), pair, strict=True)])
        )
        for k, pair in enumerate(zip(*sides, strict=True))
    ]  # fmt: skip
    delay = int(np.clip(10 * round(100 * stride / before.fps), 30, 500))
    stream = io.BytesIO()
    frames[0].save(stream, "GIF", save_all=True, append_images=frames[1:], duration=delay, loop=0, disposal=1)
    return stream.getvalue()


def _colours(names: Names) -> list[list[int]]:
    known = list(dict.fromkeys([*names[0], *names[1]]))
    return [[known.index(name) for name in side] for side in names]


def _largest(*observations: Observation) -> float:
    """The flow [px] that gets full colour: the 98 % quantile of all that moves."""
    lengths = [np.linalg.norm(o.flow, axis=-1) for o in observations]
    moving = np.concatenate([length[np.isfinite(length) & (length > 0.05)] for length in lengths])
    return max(float(np.quantile(moving, 0.98)), 0.2) if moving.size else 1.0


def _fitted(image: UInt8[np.ndarray, "h w 3"], width: int = _WIDTH) -> UInt8[np.ndarray, "height width 3"]:
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    way = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_NEAREST
    return cv2.resize(image, (width, height), interpolation=way)


def _labelled(image: UInt8[np.ndarray, "height width 3"], text: str) -> UInt8[np.ndarray, "height width 3"]:
    image = image.copy()
    cv2.putText(image, text, (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _EDGE, 1, cv2.LINE_AA)
    image[:, :1] = image[:1] = 255
    return image
