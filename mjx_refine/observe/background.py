"""The empty scene behind the moving objects, learnt from frames in which they stand elsewhere."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import sparse
from scipy.sparse import csgraph

from mjx_refine.observe.untyped import ndimage, opencv

_CHUNKS = 10
_SEAM_GAIN = 0.85  # the rarer state must make a seam this much fainter than the commoner one to be the background


@dataclass(frozen=True)
class Background:
    """The empty scene.

    Attributes:
      image: RGB levels, shape (H, W, 3).
      noise: standard deviation of a pixel around it, levels, shape (H, W).
      uncovered: number of pixels where the commoner state was an object at rest and the rarer one the background.
    """

    image: Float[np.ndarray, "height width 3"]
    noise: Float[np.ndarray, "height width"]
    uncovered: int = 0


@dataclass(frozen=True)
class _States:
    """Each pixel's commonest state and its runner-up: colours, shares of the time, mean times (0..1), spread."""

    first: Float[np.ndarray, "height width 3"]
    second: Float[np.ndarray, "height width 3"]
    share: Float[np.ndarray, "height width"]
    share_second: Float[np.ndarray, "height width"]
    when: Float[np.ndarray, "height width"]
    when_second: Float[np.ndarray, "height width"]
    spread: Float[np.ndarray, "height width"]


def brightness_gain(
    frame: UInt8[np.ndarray, "height width 3"], reference: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, " 3"]:
    """Per-channel factor by which ``frame`` is brighter than ``reference`` (median over pixels not dark or clipped)."""
    gains = np.ones(3)
    for c in range(3):
        ours, theirs = frame[..., c][::2, ::2].astype(np.float32), reference[..., c][::2, ::2]
        valid = (theirs > 20) & (theirs < 235) & (ours > 5) & (ours < 250)
        if np.count_nonzero(valid) >= 50:
            gains[c] = np.median(ours[valid] / theirs[valid])
    return np.clip(gains, 0.4, 2.5)


def temporal_noise(frames: UInt8[np.ndarray, "frames height width 3"]) -> float:
    """Standard deviation of a pixel's noise, levels, from differences of successive frames (at least 1)."""
    if len(frames) < 2:
        return 1.0
    picks = np.unique(np.linspace(0, len(frames) - 2, 8).astype(int))
    steps = [np.abs(frames[k + 1, ::2, ::2].astype(np.float32) - frames[k, ::2, ::2]) for k in picks]
    # The mean of |n1 - n2| below its 80 per cent quantile is robust to moving objects and to rounding.
    values = np.concatenate([s.ravel() for s in steps])
    values = values[values <= np.quantile(values, 0.8)]
    return float(max(1.0, 1.05 * values.mean()))


def learn_background(
    frames: UInt8[np.ndarray, "frames height width 3"],
    valid: Bool[np.ndarray, "frames height width"] | None = None,
) -> Background:
    """Finds the empty scene: each pixel's commonest colour, except where that is an object resting for long.

    Args:
      frames: RGB, in order of time, all seen by one still camera (or warped to one).
      valid: where a frame may show the empty scene; None is everywhere.

    A pixel may hold two lasting states, for example background first and a stopped object later. The region of such
    pixels is shown in both states; the state whose outline shows no seam with what surrounds it is the background.
    """
    noise = temporal_noise(frames)
    states = _states(_even_brightness(frames), valid, noise)
    image, swapped = _choose(states, noise)
    if valid is not None:
        image = _fill_unknown(image.astype(np.float32), valid)
    spread = np.clip(cv2.GaussianBlur(states.spread, (0, 0), 1.5), 0.8 * noise, 4 * noise)
    return Background(image.astype(np.float32), spread.astype(np.float32), swapped)


def find_motion(frames: UInt8[np.ndarray, "frames height width 3"]) -> Bool[np.ndarray, "frames height width"]:
    """Roughly where each frame moves, from coarse flow to its neighbours in time; regions are filled.

    An object that never leaves some pixels would otherwise become their background.
    """
    height, width = frames.shape[1:3]
    scale = min(1.0, 200 / width)
    size = (max(32, round(width * scale)), max(24, round(height * scale)))
    greys = [cv2.cvtColor(cv2.resize(f, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY) for f in frames]
    dis = opencv.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    moving = np.zeros((len(frames), size[1], size[0]), bool)
    for k, (first, second) in enumerate(itertools.pairwise(greys)):
        even = np.clip(second * (np.median(first + 1.0) / np.median(second + 1.0)), 0, 255).astype(np.uint8)
        changed = cv2.absdiff(cv2.GaussianBlur(first, (0, 0), 1), cv2.GaussianBlur(even, (0, 0), 1)) > 6
        changed = ndimage.binary_dilation(changed, iterations=3)
        for at, one, other in ((k, first, even), (k + 1, even, first)):
            length = np.hypot(*np.moveaxis(dis.calc(one, other, None), -1, 0))
            moving[at] |= (length > 0.6) & changed
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    for region in moving:
        closed = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
        region[:] = ndimage.binary_fill_holes(closed)
    full = [cv2.resize(m.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0 for m in moving]
    return np.stack(full)


def _fill_unknown(
    image: Float[np.ndarray, "height width 3"], valid: Bool[np.ndarray, "frames height width"]
) -> Float[np.ndarray, "height width 3"]:
    """Continues the surroundings into pixels that no frame shows empty."""
    unknown = valid.sum(0) < max(2, round(0.04 * len(valid)))
    if not unknown.any() or unknown.all():
        return image
    levels = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    filled = cv2.inpaint(levels, unknown.astype(np.uint8), 4, cv2.INPAINT_TELEA)
    return np.where(unknown[..., None], filled.astype(np.float32), image)


def _even_brightness(
    frames: UInt8[np.ndarray, "frames height width 3"],
) -> UInt8[np.ndarray, "frames height width 3"]:
    """Takes out flicker: every frame as bright as the median of them."""
    sample = np.unique(np.linspace(0, len(frames) - 1, 25).astype(int))
    reference = np.median(frames[sample][:, ::2, ::2], axis=0).astype(np.float32)
    even = np.empty_like(frames)
    for k, frame in enumerate(frames):
        gain = brightness_gain(frame[::2, ::2], reference)
        even[k] = np.clip(np.rint(frame / gain.astype(np.float32)), 0, 255)
    return even


def _states(
    frames: UInt8[np.ndarray, "frames height width 3"],
    valid: Bool[np.ndarray, "frames height width"] | None,
    noise: float,
) -> _States:
    """Each pixel's two commonest colours among medians over stretches of time."""
    shape = frames.shape[1:3]
    everywhere = np.ones(shape, bool)
    shown = [everywhere if valid is None else v for v in (frames if valid is None else valid)]
    edges = np.unique(np.linspace(0, len(frames), min(_CHUNKS, max(1, len(frames) // 3)) + 1).astype(int))
    candidates = [_median(frames, valid)]
    for a, b in itertools.pairwise(edges):
        candidates.append(_median(frames[a:b], None if valid is None else valid[a:b]))
    threshold = int(np.ceil(max(9.0, 5.0 * noise)))

    def near(frame: np.ndarray, candidate: np.ndarray) -> np.ndarray:
        return cv2.inRange(cv2.absdiff(frame, candidate), (0, 0, 0), (threshold,) * 3) > 0

    support = np.zeros((len(candidates), *shape), np.uint16)
    for frame, seen in zip(frames, shown, strict=True):
        for votes, candidate in zip(support, candidates, strict=True):
            votes += near(frame, candidate) & seen
    stack = np.stack(candidates)
    first = np.take_along_axis(stack, support.argmax(0)[None, ..., None], axis=0)[0]
    support[:] = 0
    chosen = np.stack([near(f, first) & seen for f, seen in zip(frames, shown, strict=True)])
    for frame, seen, taken in zip(frames, shown, chosen, strict=True):
        for votes, candidate in zip(support, candidates, strict=True):
            votes += near(frame, candidate) & seen & ~taken
    second = np.take_along_axis(stack, support.argmax(0)[None, ..., None], axis=0)[0]
    chosen_second = np.stack(
        [near(f, second) & seen & ~taken for f, seen, taken in zip(frames, shown, chosen, strict=True)]
    )
    known = np.sum(shown, axis=0).astype(np.float32)
    mean, share, when, spread = _summary(frames, chosen, known, first)
    mean_second, share_second, when_second, _ = _summary(frames, chosen_second, known, first)
    return _States(mean, mean_second, share, share_second, when, when_second, spread)


def _median(
    frames: UInt8[np.ndarray, "frames height width 3"], valid: Bool[np.ndarray, "frames height width"] | None
) -> UInt8[np.ndarray, "height width 3"]:
    """Median over the frames that show the pixel; 0 where none does."""
    if valid is None:
        columns = np.ascontiguousarray(frames.reshape(len(frames), -1).T)
        return np.partition(columns, len(frames) // 2, axis=1)[:, len(frames) // 2].reshape(frames.shape[1:])
    ordered = np.sort(np.where(valid[..., None], frames, 255), axis=0)
    count = valid.sum(0)
    middle = np.take_along_axis(ordered, (count // 2)[None, ..., None].clip(max=len(frames) - 1), axis=0)[0]
    return np.where((count > 0)[..., None], middle, 0).astype(np.uint8)


def _summary(
    frames: UInt8[np.ndarray, "frames height width 3"],
    chosen: Bool[np.ndarray, "frames height width"],
    known: Float[np.ndarray, "height width"],
    otherwise: UInt8[np.ndarray, "height width 3"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean colour, share of the time, mean time and spread of each pixel's chosen moments."""
    total, squares = np.zeros(frames.shape[1:], np.float32), np.zeros(frames.shape[1:], np.float32)
    moments = np.zeros(frames.shape[1:3], np.float32)
    times = np.linspace(0.0, 1.0, len(frames), dtype=np.float32)
    for frame, taken, time in zip(frames, chosen, times, strict=True):
        step = np.where(taken[..., None], frame.astype(np.float32) - otherwise, 0)
        total += step
        squares += step * step
        moments += time * taken
    count = chosen.sum(0).astype(np.float32)
    safe = np.maximum(count, 1)
    mean = total / safe[..., None]
    spread = np.sqrt(np.maximum(squares / safe[..., None] - mean * mean, 0)).mean(-1)
    return mean + otherwise, count / np.maximum(known, 1), moments / safe, spread


def _choose(states: _States, noise: float) -> tuple[Float[np.ndarray, "height width 3"], int]:
    image = states.first.copy()
    contrast = np.abs(states.first - states.second).max(-1)
    double = (states.share_second > 0.05) & (contrast > max(12.0, 6 * noise))
    double = ndimage.binary_opening(double, np.ones((2, 2), bool))
    double = ndimage.binary_closing(double, np.ones((3, 3), bool)) & (contrast > 4 * noise)
    labels, sizes = _same_history(double, states)
    changed = _swap(image, states, double, labels, sizes)
    if changed.any():
        # What is left of the same resting place: pieces that something else also passed.
        beside = ndimage.binary_dilation(changed, iterations=4) & double & ~changed
        labels, count = ndimage.label(beside, np.ones((3, 3), bool))
        changed |= _swap(image, states, double & ~changed, labels, np.bincount(labels.ravel(), minlength=count + 1)[1:])
    return image, int(np.count_nonzero(changed))


def _swap(
    image: Float[np.ndarray, "height width 3"],
    states: _States,
    double: Bool[np.ndarray, "height width"],
    labels: Int[np.ndarray, "height width"],
    sizes: Int[np.ndarray, " regions"],
) -> Bool[np.ndarray, "height width"]:
    """Puts the rarer state into ``image`` where it makes the fainter seam; returns where."""
    changed = np.zeros(double.shape, bool)
    for label in np.argsort(-sizes, kind="stable"):
        if sizes[label] < 5:
            break
        rows, cols = np.nonzero(labels == label + 1)
        window = _window(rows, cols, labels.shape, 8)
        region = labels[window] == label + 1
        elsewhere = double[window] & ~region & ~changed[window] & (states.share_second[window] > 0.3)
        seam_first = _seam(states.first[window], image[window], region, elsewhere)
        seam_second = _seam(states.second[window], image[window], region, elsewhere)
        share, rival = states.share[window][region].mean(), states.share_second[window][region].mean()
        # The longer state has the prior: a rare one needs a clearer seam.
        if rival > 0.1 and seam_second < _SEAM_GAIN * seam_first * min(1.0, 0.6 + rival / max(share, 1e-6)):
            image[window][region] = states.second[window][region]
            changed[window] |= region
    return changed


def _same_history(
    double: Bool[np.ndarray, "height width"], states: _States
) -> tuple[Int[np.ndarray, "height width"], Int[np.ndarray, " regions"]]:
    """Connects neighbours that change between their states at the same time: one resting place is one region."""
    height, width = double.shape
    number = np.arange(height * width).reshape(height, width)
    pairs = []
    for a, b in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        linked = double[a] & double[b]
        linked &= np.abs(states.when[a] - states.when[b]) < 0.06
        linked &= np.abs(states.when_second[a] - states.when_second[b]) < 0.12
        # Two neighbours may change at the same moment in opposite ways: one object arrives, another leaves.
        same = _step(states.first[a], states.first[b]) + _step(states.second[a], states.second[b])
        crossed = _step(states.first[a], states.second[b]) + _step(states.second[a], states.first[b])
        linked &= same <= crossed
        pairs.append(np.stack([number[a][linked], number[b][linked]]))
    edges = np.concatenate(pairs, axis=1)
    graph = sparse.coo_matrix((np.ones(edges.shape[1]), (edges[0], edges[1])), shape=(height * width,) * 2)
    _, component = csgraph.connected_components(graph, directed=False)
    inside = double.ravel()
    _, compact = np.unique(component[inside], return_inverse=True)
    labels = np.zeros(height * width, np.int64)
    labels[inside] = compact + 1
    sizes = np.bincount(compact) if compact.size else np.zeros(0, np.int64)
    return labels.reshape(height, width), sizes


def _step(one: Float[np.ndarray, "h w 3"], other: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    return np.abs(one - other).max(-1)


def _window(rows: np.ndarray, cols: np.ndarray, shape: tuple[int, ...], margin: int) -> tuple[slice, slice]:
    return (
        slice(max(0, rows.min() - margin), min(shape[0], rows.max() + margin + 1)),
        slice(max(0, cols.min() - margin), min(shape[1], cols.max() + margin + 1)),
    )


def _seam(
    state: Float[np.ndarray, "h w 3"],
    around: Float[np.ndarray, "h w 3"],
    region: Bool[np.ndarray, "h w"],
    elsewhere: Bool[np.ndarray, "h w"],
) -> float:
    """Mean colour step across the region's outline, from just inside (in ``state``) to just outside."""
    square = np.ones((3, 3), bool)
    inner = region & ~ndimage.binary_erosion(region, square, iterations=3, border_value=1)
    grown = ndimage.binary_dilation(region, square, iterations=2)
    outer = ndimage.binary_dilation(grown, square, iterations=2) & ~grown & ~elsewhere
    if not outer.any() or not inner.any():
        return float("inf")
    _, nearest = ndimage.distance_transform_edt(~outer, return_indices=True)
    rows, cols = np.nonzero(inner)
    steps = state[rows, cols] - around[nearest[0][rows, cols], nearest[1][rows, cols]]
    return float(np.abs(steps).max(-1).mean() + 1.0)
