"""Dense optical flow between the kept frames, guided by the tracked objects, with its noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mjx_refine.observe.untyped import ndimage, opencv

_MARGIN = 12  # px around an object's crop
_PLAY = 0.2  # px; how far an object's flow is expected to be from its rigid motion in the picture
_FLOOR = 0.03  # px; DIS is never better
_CEILING = 8.0  # px


@dataclass(frozen=True)
class FlowField:
    """Flow of every interval.

    Attributes:
      flow: pixels per frame, NaN where not measured, shape (T-1, H, W, 2).
      sigma: standard deviation of its noise, px, shape (T-1, H, W).
      background_sigma: robust standard deviation where nothing moves (camera motion taken out), px.
    """

    flow: Float[np.ndarray, "intervals height width 2"]
    sigma: Float[np.ndarray, "intervals height width"]
    background_sigma: float


def make_dis(width: int) -> Any:
    """Dense inverse search (Kroeger et al., ECCV 2016), medium preset, down to full resolution on small crops."""
    dis = opencv.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    if width <= 200:
        dis.setFinestScale(0)
    return dis


def measure_flow(
    frames: UInt8[np.ndarray, "frames height width 3"], masks: Int[np.ndarray, "frames height width"] | None
) -> FlowField:
    """Measures the flow from each frame to the next.

    Where a forward and a backward pass clearly disagree the flow is NaN, except inside objects: these are measured
    again, each alone, after its own displacement and turn have been taken out, so that small and fast ones are
    followed too. The noise grows where the picture has no texture (from the structure tensor) and with the
    forward-backward error.
    """
    greys = [cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in frames]
    count, height, width = len(frames), *frames.shape[1:3]
    dis = make_dis(width)
    flow = np.empty((count - 1, height, width, 2), np.float32)
    sigma = np.empty((count - 1, height, width), np.float32)
    quiet = []
    for t in range(count - 1):
        forward = dis.calc(greys[t], greys[t + 1], None)
        backward = dis.calc(greys[t + 1], greys[t], None)
        error = _disagreement(forward, backward)
        flow[t], sigma[t] = forward, np.maximum(0.5 * error, _FLOOR)
        wrong = error > 0.75 + 0.15 * np.hypot(*np.moveaxis(forward, -1, 0))
        flow[t][wrong] = np.nan
        objects = np.zeros((height, width), bool)
        if masks is not None:
            objects = (masks[t] > 0) | (masks[t + 1] > 0)
            for number in np.unique(masks[t][masks[t] > 0]):
                here, there = masks[t] == number, masks[t + 1] == number
                _measure_object(
                    _contrasting(frames[t], frames[t + 1], here), (here, there), (flow[t], sigma[t], forward)
                )
        grown = ndimage.binary_dilation(objects, iterations=10)
        spread, smooth = _background_motion(flow[t], ~grown)
        quiet.append(spread)
        # Beside an object the window drags the background along; the mask knows that it is background.
        dragged = np.hypot(*np.moveaxis(forward - smooth, -1, 0)) > max(0.4, 4 * spread)
        flow[t][grown & dragged & (masks[t] == 0 if masks is not None else True)] = np.nan
    background = float(np.median(quiet)) if quiet else _FLOOR
    still = np.ones(sigma.shape, bool) if masks is None else masks[:-1] == 0
    sigma[still] = np.maximum(sigma[still], background)
    sigma = np.clip(sigma, _FLOOR, _CEILING)
    return FlowField(flow, sigma.astype(np.float32), max(background, _FLOOR))


def _background_motion(
    flow: Float[np.ndarray, "height width 2"], still: Bool[np.ndarray, "height width"]
) -> tuple[float, Float[np.ndarray, "height width 2"]]:
    """Robust spread of the background's flow about an affine field, px, and that field."""
    height, width = still.shape
    rows, cols = np.nonzero(still & np.isfinite(flow[..., 0]))
    if len(rows) < 50:
        return _FLOOR, np.zeros((height, width, 2), np.float32)
    pick = slice(None, None, max(1, len(rows) // 4000))
    rows, cols = rows[pick] / height, cols[pick] / width
    basis = np.stack([np.ones(len(rows)), rows, cols], axis=1)
    values = flow[still & np.isfinite(flow[..., 0])][pick].astype(np.float64)
    fit = np.array([np.median(values, axis=0), [0, 0], [0, 0]])
    for _ in range(4):
        rest = values - basis @ fit
        size = np.abs(rest).max(-1)
        keep = size <= max(3 * float(np.median(size)), 1e-3)
        fit, *_ = np.linalg.lstsq(basis[keep], values[keep], rcond=None)
    rest = values - basis @ fit
    ys, xs = np.mgrid[:height, :width]
    plane = np.stack([np.ones_like(ys, float), ys / height, xs / width], axis=-1) @ fit
    return float(1.4826 * np.median(np.abs(rest))), plane.astype(np.float32)


def _disagreement(
    forward: Float[np.ndarray, "height width 2"], backward: Float[np.ndarray, "height width 2"]
) -> Float[np.ndarray, "height width"]:
    """Length of forward + backward at the forward's target, px."""
    height, width = forward.shape[:2]
    back = _sample(backward, _pixels((slice(0, height), slice(0, width))) + forward)
    return np.hypot(*np.moveaxis(forward + back, -1, 0))


def _contrasting(
    first: UInt8[np.ndarray, "height width 3"],
    second: UInt8[np.ndarray, "height width 3"],
    region: Bool[np.ndarray, "height width"],
) -> tuple[UInt8[np.ndarray, "height width"], UInt8[np.ndarray, "height width"]]:
    """Grey pictures in which the object stands out: brightness, or the axis of colour in which it differs."""
    near = ndimage.binary_dilation(region, iterations=2)
    ring = ndimage.binary_dilation(near, iterations=4) & ~near
    greys = cv2.cvtColor(first, cv2.COLOR_RGB2GRAY), cv2.cvtColor(second, cv2.COLOR_RGB2GRAY)
    if not ring.any():
        return greys
    inside, outside = first[region].mean(0), first[ring].mean(0)
    contrast = inside - outside
    length = float(np.linalg.norm(contrast))
    if abs(float(greys[0][region].mean()) - float(greys[0][ring].mean())) > 0.5 * length or length < 10:
        return greys
    axis, middle = contrast / length, 0.5 * (inside + outside)
    one, other = (
        np.clip(np.rint(128 + (f.astype(np.float32) - middle) @ axis), 0, 255).astype(np.uint8) for f in (first, second)
    )
    return one, other


def _measure_object(
    greys: tuple[UInt8[np.ndarray, "height width"], UInt8[np.ndarray, "height width"]],
    regions: tuple[Bool[np.ndarray, "height width"], Bool[np.ndarray, "height width"]],
    outputs: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Measures one object's flow on crops that its rigid motion has aligned; keeps it where it explains the pictures
    better than the plain flow."""
    flow, sigma, plain = outputs
    here, there = regions
    if not there.any() or not 0.4 < np.count_nonzero(here) / np.count_nonzero(there) < 2.5:
        aperture = _texture_sigma(greys[0], here)
        sigma[here] = np.maximum(sigma[here], aperture[here])
        return
    window = _window(here, there)
    motion = _rigid_motion(greys, regions, window)
    first = np.ascontiguousarray(_on_plain(greys[0], here)[window])
    second = _on_plain(greys[1], there)[window]
    corner = np.array([window[1].start, window[0].start], np.float32)
    pixels = _pixels(window)
    shift = _subpixel_shift(
        np.ascontiguousarray(greys[0][window]), _sample(greys[1], _moved(motion, pixels)), here[window]
    )
    motion[:, 2] += motion[:, :2] @ shift
    aligned = _sample(second, _moved(motion, pixels) - corner)
    rest, error = _small_flow(first, aligned)
    aperture = _texture_sigma(greys[0], here)[window]
    # Where the object shows no texture it moves as a whole.
    rest *= (_PLAY**2 / (_PLAY**2 + np.square(aperture)))[..., None]
    guided = _moved(motion, pixels + rest) - pixels
    inside = here[window]
    landed = _lands(guided, there, window)
    cost_guided = _photometric(greys, guided, window)[inside]
    cost_plain = _photometric(greys, plain[window], window)[inside]
    plain_lands = _lands(plain[window], there, window)
    score_guided = cost_guided.mean() + 40 * np.mean(~landed[inside])
    score_plain = cost_plain.mean() + 40 * np.mean(~plain_lands[inside])
    view_flow, view_sigma = flow[window], sigma[window]
    # Plain flow explains flat insides as well as true flow does, so it has to be clearly better.
    if score_guided <= 1.3 * score_plain + 2:
        view_flow[inside] = guided[inside]
        view_sigma[inside] = np.maximum(0.5 * error, _FLOOR)[inside]
        view_flow[inside & ((error > 2.0 + 0.3 * np.hypot(*np.moveaxis(guided, -1, 0))) & ~landed)] = np.nan
    view_sigma[inside] = np.hypot(view_sigma, aperture)[inside]


def _pixels(window: tuple[slice, slice]) -> Float[np.ndarray, "h w 2"]:
    """Each pixel's (column, row) in the whole picture."""
    rows, cols = np.mgrid[window].astype(np.float32)
    return np.stack([cols, rows], axis=-1)


def _moved(motion: Float[np.ndarray, "2 3"], points: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 2"]:
    return (points @ motion[:, :2].T + motion[:, 2]).astype(np.float32)


def _sample(image: np.ndarray, points: Float[np.ndarray, "h w 2"]) -> np.ndarray:
    """The image at (column, row) points, bilinear."""
    return opencv.remap(
        image, np.ascontiguousarray(points, np.float32), None, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
    )


def _window(here: np.ndarray, there: np.ndarray) -> tuple[slice, slice]:
    rows, cols = np.nonzero(here | there)
    return (
        slice(max(0, rows.min() - _MARGIN), min(here.shape[0], rows.max() + _MARGIN + 1)),
        slice(max(0, cols.min() - _MARGIN), min(here.shape[1], cols.max() + _MARGIN + 1)),
    )


def _subpixel_shift(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"], region: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, " 2"]:
    """Displacement (x, y) of at most 2.5 px that is left between two aligned crops (ECC, Evangelidis & Psarakis 2008).

    Outlines are whole pixels, so that their centroids are off by a fraction of one.
    """
    near = ndimage.binary_dilation(region, iterations=2).astype(np.uint8)
    rule = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-4)
    try:
        _, matrix = cv2.findTransformECC(
            first, second, np.eye(2, 3, dtype=np.float32), cv2.MOTION_TRANSLATION, rule, near, 3
        )
    except cv2.error:  # no contrast, or no convergence: the centroids have to do
        return np.zeros(2, np.float32)
    shift = matrix[:, 2].astype(np.float32)
    return shift if float(np.hypot(*shift)) < 2.5 else np.zeros(2, np.float32)


def _on_plain(
    grey: UInt8[np.ndarray, "height width"], region: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width"]:
    """The object with its true edges, fading into a plain ground of the background's mean, so that the background's
    texture pulls at nothing."""
    near = ndimage.binary_dilation(region, iterations=2)
    ring = ndimage.binary_dilation(near, iterations=3) & ~near
    ground = float(np.median(grey[ring])) if ring.any() else float(grey.mean())
    soft = cv2.GaussianBlur(near.astype(np.float32), (0, 0), 1.0)
    return np.clip(np.rint(soft * grey + (1 - soft) * ground), 0, 255).astype(np.uint8)


def _rigid_motion(
    greys: tuple[np.ndarray, np.ndarray], regions: tuple[np.ndarray, np.ndarray], window: tuple[slice, slice]
) -> Float[np.ndarray, "2 3"]:
    """Displacement of the outline, and the turn (at most 60 degrees) that matches the texture clearly better than none."""
    here, there = regions
    start, end = _centroid(here), _centroid(there)
    rows, cols = np.nonzero(here)
    inner = ndimage.binary_erosion(here, iterations=1)
    if np.count_nonzero(inner) >= 30:
        rows, cols = np.nonzero(inner)
    values = cv2.GaussianBlur(greys[0], (0, 0), 0.8)[rows, cols].astype(np.float32)
    second = cv2.GaussianBlur(greys[1], (0, 0), 0.8)
    offsets = np.stack([cols - start[0], rows - start[1]])
    best, best_score, still_score = 0.0, np.inf, np.inf
    for degrees in range(-60, 61, 4):
        a = np.radians(degrees)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        seen = _sample(second, (turn @ offsets + end[:, None]).T[None])[0].astype(np.float32)
        score = float(np.abs(seen - values - np.median(seen - values)).mean()) + 0.01 * abs(degrees)
        if degrees == 0:
            still_score = score
        if score < best_score:
            best, best_score = a, score
    if not best_score < 0.75 * still_score - 0.5:
        best = 0.0
    cos, sin = np.cos(best), np.sin(best)
    turn = np.array([[cos, -sin], [sin, cos]])
    return np.hstack([turn, (end - turn @ start)[:, None]]).astype(np.float32)


def _centroid(region: np.ndarray) -> Float[np.ndarray, " 2"]:
    rows, cols = np.nonzero(region)
    return np.array([cols.mean(), rows.mean()])


def _small_flow(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """DIS both ways on a crop (enlarged where it is too small for its pyramid), and its disagreement."""
    height, width = first.shape
    scale = max(1, int(np.ceil(48 / min(height, width))))
    if scale > 1:
        first, second = (
            cv2.resize(g, (width * scale, height * scale), interpolation=cv2.INTER_CUBIC) for g in (first, second)
        )
    dis = make_dis(0)
    forward = dis.calc(first, second, None)
    backward = dis.calc(second, first, None)
    error = _disagreement(forward, backward)
    if scale > 1:
        forward = cv2.resize(forward, (width, height), interpolation=cv2.INTER_AREA) / scale
        error = cv2.resize(error, (width, height), interpolation=cv2.INTER_AREA) / scale
    return forward, error


def _photometric(greys: tuple[np.ndarray, np.ndarray], flow: np.ndarray, window: tuple[slice, slice]) -> np.ndarray:
    seen = _sample(greys[1], _pixels(window) + flow).astype(np.float32)
    return np.minimum(np.abs(seen - greys[0][window]), 60)


def _lands(flow: np.ndarray, there: np.ndarray, window: tuple[slice, slice]) -> np.ndarray:
    """Whether the flow's target lies on the object in the next frame (a pixel of play)."""
    ys, xs = np.mgrid[window[0], window[1]]
    grown = ndimage.binary_dilation(there, np.ones((3, 3), bool))
    rows, cols = np.rint(ys + flow[..., 1]).astype(int), np.rint(xs + flow[..., 0]).astype(int)
    inside = (rows >= 0) & (rows < there.shape[0]) & (cols >= 0) & (cols < there.shape[1])
    return grown[rows.clip(0, there.shape[0] - 1), cols.clip(0, there.shape[1] - 1)] | ~inside


def _texture_sigma(
    grey: UInt8[np.ndarray, "height width"], region: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Noise of a least-squares flow from the weaker eigenvalue of the structure tensor (Simoncelli et al. 1991), px."""
    rows, cols = np.nonzero(region)
    window = (
        slice(max(0, rows.min() - _MARGIN), rows.max() + _MARGIN + 1),
        slice(max(0, cols.min() - _MARGIN), cols.max() + _MARGIN + 1),
    )
    # Only texture of the object counts: its outline is the mask's business, not the flow's.
    patch = grey[window].astype(np.float32)
    inner = ndimage.binary_erosion(region[window], iterations=1).astype(np.float32)
    gx = cv2.Scharr(patch, cv2.CV_32F, 1, 0, scale=1 / 32) * inner
    gy = cv2.Scharr(patch, cv2.CV_32F, 0, 1, scale=1 / 32) * inner
    xx, yy, xy = (9 * 9 * cv2.blur(g, (9, 9)) for g in (gx * gx, gy * gy, gx * gy))
    weaker = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    noise = 2.0  # levels
    # Noise alone has gradients too: Scharr's kernel passes a fifth of its variance, 81 pixels add up.
    signal = weaker - 81 * 0.2 * noise**2
    sigma = np.zeros(grey.shape, np.float32)
    sigma[window] = np.minimum(noise / np.sqrt(np.maximum(signal, 1e-3)), 3.0)
    return sigma
