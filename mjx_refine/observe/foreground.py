"""Where a frame differs from the empty scene, without cast shadows, and with outlines at half coverage."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mjx_refine.observe.background import brightness_gain
from mjx_refine.observe.untyped import ndimage

_SQUARE = np.ones((3, 3), bool)
_CROSS = ndimage.generate_binary_structure(2, 1)
_LOW, _HIGH = 3.5, 7.0  # hysteresis thresholds on the change, in standard deviations
_LOW_LEVELS = 7.0  # levels; the least lower threshold, for clips whose codec hides the noise
_TINY = 80  # px; below this an object has no inside from which its colour could be taken


@dataclass(frozen=True)
class Blob:
    """One connected region of one frame.

    Attributes:
      top, left: the crop's corner, px.
      crop: the region within its bounding box.
      colour: mean RGB.
      shadow: share of pixels that a shadow would explain.
      contrast: mean change against the background, levels.
      border: share of its outline that lies on the picture's border.
      margin: distance to the picture's border, px.
    """

    top: int
    left: int
    crop: Bool[np.ndarray, "h w"]
    colour: Float[np.ndarray, " 3"]
    shadow: float
    contrast: float
    border: float
    margin: int

    @cached_property
    def area(self) -> int:
        return int(self.crop.sum())

    @cached_property
    def centre(self) -> Float[np.ndarray, " 2"]:
        """Centroid (x, y), px, with pixel centres at half-integers."""
        rows, cols = np.nonzero(self.crop)
        return np.array([cols.mean() + self.left + 0.5, rows.mean() + self.top + 0.5])

    @property
    def radius(self) -> float:
        return float(np.sqrt(self.area / np.pi))

    def paint(self, shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
        full = np.zeros(shape, bool)
        h, w = self.crop.shape
        full[self.top : self.top + h, self.left : self.left + w] = self.crop
        return full


@dataclass(frozen=True)
class Change:
    """One frame against the empty scene.

    Attributes:
      even: the frame with its brightness brought to the background's, levels, shape (H, W, 3).
      background: the empty scene as this frame's camera sees it.
      noise: standard deviation of a pixel, levels.
      strength: size of the change in units of its threshold: 1 is the lower one.
      shadow: pixels that a shadow on the background would explain.
    """

    even: Float[np.ndarray, "height width 3"]
    background: Float[np.ndarray, "height width 3"]
    noise: Float[np.ndarray, "height width"]
    strength: Float[np.ndarray, "height width"]
    shadow: Bool[np.ndarray, "height width"]


def measure_change(
    frame: UInt8[np.ndarray, "height width 3"],
    background: Float[np.ndarray, "height width 3"],
    noise: Float[np.ndarray, "height width"],
) -> Change:
    """Compares a frame with the empty scene, after taking out a global change of brightness."""
    even = frame.astype(np.float32) / brightness_gain(frame, background).astype(np.float32)
    difference = cv2.GaussianBlur(even - background, (0, 0), 0.6)
    clipped = (frame >= 254) & (background >= 250)  # both saturated: what lies beyond is not known
    difference[clipped] = 0
    size = np.abs(difference).max(-1)
    # Edges of the background move by a fraction of a pixel in a shaken or recompressed clip.
    grey = background.mean(-1)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8))
    threshold = np.maximum(_LOW * noise, _LOW_LEVELS) + 0.25 * np.minimum(slope, 40)
    strength = (size / threshold).astype(np.float32)
    return Change(even, background, noise, strength, _shadow_like(even, background, noise))


def _shadow_like(
    even: Float[np.ndarray, "height width 3"],
    background: Float[np.ndarray, "height width 3"],
    noise: Float[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Darker by a smooth factor that is much the same in every channel (Horprasert et al. 1999's idea, in RGB)."""
    floor = 6.0
    ratio = (cv2.GaussianBlur(even, (0, 0), 0.8) + floor) / (cv2.GaussianBlur(background, (0, 0), 0.8) + floor)
    level = (cv2.GaussianBlur(even, (0, 0), 0.8).sum(-1) + 3 * floor) / (
        cv2.GaussianBlur(background, (0, 0), 0.8).sum(-1) + 3 * floor
    )
    tint = np.abs(ratio / level[..., None] - 1).max(-1)
    uncertainty = noise / (background.mean(-1) + floor)
    depth = np.log(np.maximum(level, 1e-3))
    steepness = np.hypot(
        cv2.Scharr(depth, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(depth, cv2.CV_32F, 0, 1, scale=1 / 32)
    )
    return (
        (level < 0.98)
        & (level > 0.35)
        & (tint < 0.1 + 0.12 * (1 - level) + 1.5 * uncertainty)
        & (steepness < 0.12 + 0.8 * uncertainty)
    )


def find_blobs(change: Change, least_area: int) -> list[Blob]:
    """Finds the connected changed regions of at least ``least_area`` pixels, without shadows, with tight outlines."""
    high = _HIGH / _LOW
    raw = _hysteresis(change.strength, high)
    raw = ndimage.binary_closing(np.pad(raw, 2), _CROSS)[2:-2, 2:-2]
    labels, count = ndimage.label(ndimage.binary_fill_holes(raw), _SQUARE)
    blobs = []
    for label, window in enumerate(ndimage.find_objects(labels, count), start=1):
        if np.count_nonzero(labels[window] == label) < least_area:
            continue
        window = _grow(window, labels.shape, 6)
        region = _without_shadow(labels[window] == label, change, window, least_area)
        region = refine_outline(region, change, window)
        pieces, parts = ndimage.label(region, _CROSS)
        for piece in range(1, parts + 1):
            blob = make_blob(pieces == piece, change, window)
            if blob is not None and blob.area >= least_area:
                blobs.append(blob)
    return blobs


def _hysteresis(strength: Float[np.ndarray, "height width"], high: float) -> Bool[np.ndarray, "height width"]:
    weak = strength > 1
    labels, count = ndimage.label(weak, _SQUARE)
    strong = np.zeros(count + 1, bool)
    strong[labels[strength > high]] = True
    strong[0] = False
    return strong[labels]


def _grow(window: tuple[slice, ...], shape: tuple[int, ...], margin: int) -> tuple[slice, slice]:
    rows, cols = window
    return (
        slice(max(0, rows.start - margin), min(shape[0], rows.stop + margin)),
        slice(max(0, cols.start - margin), min(shape[1], cols.stop + margin)),
    )


def _without_shadow(
    region: Bool[np.ndarray, "h w"], change: Change, window: tuple[slice, slice], least_area: int
) -> Bool[np.ndarray, "h w"]:
    """Takes away shadow-like parts on the region's outside, where a body remains that no shadow explains."""
    shadow = _shadow_within(region, change, window) & region
    body = ndimage.binary_opening(region & ~shadow, _CROSS)
    if np.count_nonzero(body) < max(4, 0.12 * np.count_nonzero(region), 0.5 * least_area):
        return region
    body = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(body, 3), _SQUARE)[3:-3, 3:-3])
    kept = region & (body | ~shadow)
    labels, count = ndimage.label(kept, _CROSS)
    if count > 1:  # crumbs of penumbra
        sizes = ndimage.sum_labels(kept, labels, np.arange(1, count + 1))
        kept = np.isin(labels, 1 + np.nonzero(sizes >= max(least_area, 0.15 * sizes.max()))[0])
    return kept


def refine_outline(
    region: Bool[np.ndarray, "h w"], change: Change, window: tuple[slice, slice]
) -> Bool[np.ndarray, "h w"]:
    """Puts the outline where object and background have equal shares of the pixel.

    With the object's colour F taken from nearby inside and the background's B known, a pixel I = a F + (1 - a) B has
    the coverage a = (I - B)·(F - B) / |F - B|^2; the outline is a = 1/2. Blurred edges (motion, focus, compression)
    are thereby halved rather than swallowed.
    """
    even, background, noise = change.even[window], change.background[window], change.noise[window]
    area = int(np.count_nonzero(region))
    if area == 0:
        return region
    difference = even - background
    if area < _TINY:
        size = np.linalg.norm(difference, axis=-1)
        clear = region & (size > 0.25 * np.quantile(size[region], 0.85))
        return region & convex_hull(_tidy(clear, area))
    shadow = _shadow_within(region, change, window)
    allowed = region | (ndimage.binary_dilation(region, _SQUARE, iterations=2) & ~shadow)
    for _ in range(3):  # the first inside may hold some shadow or halo
        refined = _at_half_coverage(region, even, background, noise) & allowed
        if not refined.any() or np.array_equal(refined, region):
            break
        region = refined
    return _tidy(region, area)


def _at_half_coverage(
    region: Bool[np.ndarray, "h w"],
    even: Float[np.ndarray, "h w 3"],
    background: Float[np.ndarray, "h w 3"],
    noise: Float[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    depth = ndimage.distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1]
    core = depth > min(2.6, 0.5 * depth.max())
    scale = max(2.0, 0.25 * float(np.sqrt(np.count_nonzero(region) / np.pi)))
    weight = cv2.GaussianBlur(core.astype(np.float32), (0, 0), scale)
    inside = cv2.GaussianBlur(even * core[..., None], (0, 0), scale) / np.maximum(weight, 1e-6)[..., None]
    contrast = inside - background
    squared = np.square(contrast).sum(-1)
    coverage = ((even - background) * contrast).sum(-1) / np.maximum(squared, 1e-6)
    band = ndimage.binary_dilation(region, _SQUARE, iterations=3) & ~core & (weight > 1e-4)
    telling = np.sqrt(squared) > 5 * noise + 6
    refined = np.where(band & telling, coverage > 0.5, region)
    return ndimage.binary_fill_holes(np.pad(refined, 1))[1:-1, 1:-1]


def _tidy(region: Bool[np.ndarray, "h w"], area: int) -> Bool[np.ndarray, "h w"]:
    """Fills holes and takes off what sticks out on thin stalks."""
    padded = ndimage.binary_fill_holes(np.pad(region, 2))
    if area >= _TINY:
        padded = ndimage.binary_closing(padded, _CROSS)
        padded = _without_tails(ndimage.binary_opening(ndimage.binary_fill_holes(padded), _CROSS))
    return padded[2:-2, 2:-2]


def _without_tails(region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Opens with a disc of half the radius, but leaves the corners, which end near the opened shape."""
    radius = float(np.sqrt(np.count_nonzero(region) / np.pi))
    inscribed = float(ndimage.distance_transform_edt(np.pad(region, 1)).max())
    reach = max(1, round(min(0.5 * radius, 0.6 * inscribed)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    wide = np.pad(region, reach + 1).astype(np.uint8)
    opened = cv2.morphologyEx(wide, cv2.MORPH_OPEN, kernel)[reach + 1 : -reach - 1, reach + 1 : -reach - 1] > 0
    if not opened.any():
        return region
    far = ndimage.distance_transform_edt(~opened)
    rest, count = ndimage.label(region & ~opened, _CROSS)
    if count == 0:
        return region
    lengths = ndimage.maximum(far, rest, np.arange(1, count + 1))
    tails = np.isin(rest, 1 + np.nonzero(np.asarray(lengths) > 1.0 + 0.22 * radius)[0])
    return region & ~tails


def make_blob(region: Bool[np.ndarray, "h w"], change: Change, window: tuple[slice, slice]) -> Blob | None:
    """Describes a region given within a window of the picture; None if it is empty."""
    if not region.any():
        return None
    rows, cols = np.nonzero(region)
    inner = (slice(rows.min(), rows.max() + 1), slice(cols.min(), cols.max() + 1))
    crop = region[inner]
    top, left = window[0].start + inner[0].start, window[1].start + inner[1].start
    height, width = change.noise.shape
    outline = crop & ~ndimage.binary_erosion(np.pad(crop, 1), _SQUARE)[1:-1, 1:-1]
    r, c = np.nonzero(outline)
    edge = (r + top <= 0) | (c + left <= 0) | (r + top >= height - 1) | (c + left >= width - 1)
    even, back = change.even[window][region], change.background[window][region]
    return Blob(
        int(top),
        int(left),
        crop,
        even.mean(0),
        float(_shadow_within(region, change, window)[region].mean()),
        float(np.abs(even - back).max(-1).mean()),
        float(edge.mean()),
        int(min(top, left, height - top - crop.shape[0], width - left - crop.shape[1])),
    )


def _shadow_within(
    region: Bool[np.ndarray, "h w"], change: Change, window: tuple[slice, slice]
) -> Bool[np.ndarray, "h w"]:
    """Shadow-like pixels; on small regions, all edge, fine detail in the brightness speaks against it."""
    shadow = change.shadow[window]
    if np.count_nonzero(region) < 2 * _TINY:
        ratio = (change.even[window].sum(-1) + 18) / (change.background[window].sum(-1) + 18)
        depth = np.log(np.maximum(ratio, 1e-3)).astype(np.float32)
        detail = np.abs(depth - cv2.GaussianBlur(depth, (0, 0), 1.2)) > 0.09
        shadow = shadow & ~ndimage.binary_dilation(detail, _CROSS)
    return shadow


def convex_hull(region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose centres lie in the convex hull of the region's pixel centres."""
    if not region.any():
        return region
    contours, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = np.zeros(region.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(contours)), 1)
    return hull > 0


def convex_fill(region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Fills the notches of a nearly convex region: spheres, boxes and cylinders look convex from everywhere."""
    area = int(np.count_nonzero(region))
    if area < 12:
        return region
    hull = convex_hull(region)
    # A hull of pixel centres bulges by part of a pixel over a digital disc; the closing takes that back.
    added = np.count_nonzero(hull) - area
    if added <= 0 or added > 0.25 * area:
        return region
    size = 2 * max(2, round(0.5 * np.sqrt(area / np.pi))) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    padded = cv2.copyMakeBorder(region.astype(np.uint8), size, size, size, size, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[size:-size, size:-size]
    return region | ((closed > 0) & hull)
