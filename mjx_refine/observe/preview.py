"""A contact sheet of an observation: outlines, ids and flow."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mjx_refine.errors import InputError
from mjx_refine.files import write_atomic
from mjx_refine.observation import Observation, save_observation
from mjx_refine.observe.clip import ObserveResult

_COLOURS = np.array(
    [[255, 214, 0], [0, 200, 255], [255, 80, 160], [90, 230, 90], [255, 130, 30], [170, 120, 255], [255, 255, 255]]
)
_TILE = 360  # px


def flow_colours(flow: Float[np.ndarray, "height width 2"], largest: float) -> UInt8[np.ndarray, "height width 3"]:
    """Flow as colour: hue is the direction (right is red), saturation the length, grey is unmeasured."""
    known = np.isfinite(flow[..., 0])
    u, v = np.nan_to_num(flow[..., 0]), np.nan_to_num(flow[..., 1])
    hue = np.degrees(np.arctan2(v, u)) % 360
    length = np.clip(np.hypot(u, v) / max(largest, 1e-6), 0, 1)
    hsv = np.stack([hue.astype(np.float32), length.astype(np.float32), np.ones_like(length, np.float32)], axis=-1)
    rgb = np.rint(255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)).astype(np.uint8)
    rgb[~known] = 90
    return rgb


def _wheel(size: int) -> UInt8[np.ndarray, "size size 3"]:
    ys, xs = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    wheel = np.stack([xs, ys], axis=-1)
    colours = flow_colours(wheel, 1.0)
    colours[np.hypot(xs, ys) > 1] = 0
    return colours


def preview(result: ObserveResult | Observation, tiles: int = 6) -> UInt8[np.ndarray, "height width 3"]:
    """Draws a sheet, RGB: evenly spread frames with coloured outlines and ids, the flow from each to the next below."""
    observation = result.observation if isinstance(result, ObserveResult) else result
    count = observation.length
    picks = np.unique(np.linspace(0, count - 1, min(tiles, count)).astype(int))
    width = observation.size[0]
    scale = max(1, round(_TILE / width)) if width < _TILE else _TILE / width
    moving = observation.masks[:-1] > 0 if observation.masks is not None else np.isfinite(observation.flow[..., 0])
    lengths = np.hypot(*np.moveaxis(observation.flow[moving & np.isfinite(observation.flow[..., 0])], -1, 0))
    largest = float(np.quantile(lengths, 0.98)) if lengths.size else 1.0
    largest = max(largest, 0.2)
    rows = []
    for start in range(0, len(picks), 3):
        chosen = list(picks[start : start + 3])
        top = [_frame_tile(observation, t, scale) for t in chosen]
        bottom = [_flow_tile(observation, min(t, count - 2), scale, largest) for t in chosen]
        while len(top) < 3 and len(picks) > 3:
            top.append(np.zeros_like(top[0]))
            bottom.append(np.zeros_like(bottom[0]))
        rows += [np.hstack(top), np.hstack(bottom)]
    return np.vstack(rows)


def _frame_tile(observation: Observation, t: int, scale: float) -> UInt8[np.ndarray, "h w 3"]:
    width, height = observation.size
    plain = np.full((height, width, 3), 40, np.uint8)
    image = plain if observation.frames is None else observation.frames[t]
    size = (round(width * scale), round(height * scale))
    image = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    if observation.masks is not None:
        for number in (n for n in np.unique(observation.masks[t]) if n):
            red, green, blue = (int(c) for c in _COLOURS[(number - 1) % len(_COLOURS)])
            colour = red, green, blue
            mask = (observation.masks[t] == number).astype(np.uint8)
            mask = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
            contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(image, contours, -1, colour, 1)
            x, y, w, _ = cv2.boundingRect(np.concatenate(contours))
            _text(image, str(number), (min(x + w + 2, size[0] - 14), max(y, 12)), colour)
    _text(image, f"frame {t}", (4, 14), (255, 255, 255))
    return image


def _flow_tile(observation: Observation, t: int, scale: float, largest: float) -> UInt8[np.ndarray, "h w 3"]:
    width, height = observation.size
    image = flow_colours(observation.flow[t], largest)
    image = cv2.resize(image, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_NEAREST)
    wheel = _wheel(min(41, image.shape[0] // 4))
    image[-wheel.shape[0] :, : wheel.shape[1]] = wheel
    _text(image, f"{t}-{t + 1}, wheel {largest:.1f} px", (wheel.shape[1] + 6, image.shape[0] - 8), (0, 0, 0))
    return image


def _text(image: np.ndarray, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    shade = (0, 0, 0) if sum(colour) > 200 else (255, 255, 255)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, shade, 3, cv2.LINE_AA)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)


def write_preview(result: ObserveResult | Observation, path: str | os.PathLike) -> Path:
    """Writes the sheet as PNG, whole or not at all."""
    encoded, data = cv2.imencode(".png", cv2.cvtColor(preview(result), cv2.COLOR_RGB2BGR))
    if not encoded:
        raise InputError(f"{path}: the preview cannot be encoded as PNG; choose a smaller --size")
    return write_atomic(path, lambda stream: stream.write(data.tobytes()))


def write_result(result: ObserveResult, out: str | os.PathLike) -> Path:
    """Writes the observation to ``out`` and the sheet beside it (``flows.npz`` -> ``flows.preview.png``).

    Returns:
      The sheet's path.
    """
    out = Path(out)
    save_observation(out, result.observation)
    return write_preview(result, out.with_name(f"{out.stem}.preview.png"))
