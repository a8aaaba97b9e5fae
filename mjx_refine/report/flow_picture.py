"""Flow, its error and their legends as pictures; what was not measured is hatched."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mjx_refine.observation import Observation
from mjx_refine.observe.preview import flow_colours
from mjx_refine.view.tiles import foreground

_DARK, _LIGHT = 84, 112


def largest_flow(observation: Observation) -> float:
    """The flow [px] that gets full colour: the 98 % quantile of the observed foreground's, at least 0.2."""
    chosen = _speeds(observation.flow[foreground(observation)[:-1] > 0])
    if not chosen.size:
        chosen = _speeds(observation.flow)
    return max(float(np.quantile(chosen, 0.98)), 0.2) if chosen.size else 1.0


def _speeds(flow: Float[np.ndarray, "*pixels 2"]) -> Float[np.ndarray, "measured"]:
    speed = np.linalg.norm(flow, axis=-1)
    return speed[np.isfinite(speed)]


def flow_picture(
    flow: Float[np.ndarray, "h w 2"], largest: float, size: tuple[int, int]
) -> UInt8[np.ndarray, "height width 3"]:
    """Flow as colour: hue is the direction (right is red), saturation the length, white none.

    Args:
      flow: [px/frame], NaN where unmeasured.
      largest: length with full saturation [px/frame].
      size: (width, height) of the picture [px].
    """
    flow = np.where(np.isfinite(flow).all(-1, keepdims=True), flow, np.nan)
    return _hatched(flow_colours(flow, largest), np.isnan(flow[..., 0]), size)


def error_picture(
    error: Float[np.ndarray, "h w"], largest: float, size: tuple[int, int]
) -> UInt8[np.ndarray, "height width 3"]:
    """End-point error [px] as heat: black none, bright yellow ``largest`` and more, hatched where unmeasured."""
    return _hatched(_heat(error, largest), ~np.isfinite(error), size)


def wheel(size: int) -> UInt8[np.ndarray, "size size 3"]:
    """The legend of ``flow_picture``: the colour of every direction, white in the middle."""
    ys, xs = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    disc = np.stack([xs, ys], axis=-1)
    colours = flow_colours(disc, 1.0)
    colours[np.hypot(xs, ys) > 1] = 255
    return colours


def heat_bar(width: int, height: int) -> UInt8[np.ndarray, "height width 3"]:
    """The legend of ``error_picture``, from none on the left to the largest."""
    return _heat(np.tile(np.linspace(0.0, 1.0, width), (height, 1)), 1.0)


def _heat(values: Float[np.ndarray, "h w"], largest: float) -> UInt8[np.ndarray, "h w 3"]:
    level = np.rint(255 * np.clip(np.nan_to_num(values, posinf=0.0) / largest, 0, 1)).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def _hatched(
    colours: UInt8[np.ndarray, "h w 3"], unknown: Bool[np.ndarray, "h w"], size: tuple[int, int]
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture at ``size`` with grey stripes over what is unknown."""
    way = cv2.INTER_AREA if size[0] < colours.shape[1] else cv2.INTER_NEAREST
    image = cv2.resize(colours, size, interpolation=way)
    where = cv2.resize(unknown.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
    rows, columns = np.mgrid[: size[1], : size[0]]
    stripes = np.where((rows + columns) // 4 % 2 == 0, _DARK, _LIGHT).astype(np.uint8)
    image[where] = stripes[where, None]
    return image
