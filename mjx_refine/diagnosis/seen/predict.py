"""What scenes predict of a clip's measurements: reach and moments of masks, flow on the objects and beside them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Float, Int

from mjx_refine.batch import SceneBatch
from mjx_refine.compile_cache import jit_quickly
from mjx_refine.diagnosis.seen.drawn_along import drawn_along
from mjx_refine.diagnosis.seen.measure import Measured, Parts
from mjx_refine.effects import acting
from mjx_refine.effects.kind import OutlineView
from mjx_refine.scene import Shape
from mjx_refine.search.features import DIRECTIONS
from mjx_refine.view.moments import whole_function
from mjx_refine.view.outline import Arrays, directions, padded, place, support_of
from mjx_refine.view.points import point_flow_function
from mjx_refine.view.seen import (
    MANY,
    bends,
    bent_flow,
    changed_moments,
    changed_polygon,
    directions_for,
    focal_length,
    moments_within,
    outline_function,
    straight_pixels,
    within_function,
)

ROWS = 8
"""Candidates that are predicted at a time, a line search's or a part of derivatives': one size is compiled, which takes seconds,
and a row takes as long in larger ones."""

CACHED = 4
"""Rows whose outlines are changed at a time."""

EDGE = 0.5
"""Over what distance from an outline flow becomes that of what lies beside it [px]."""


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Of B candidates.

    Attributes:
      reach: support functions of the silhouettes [px]; NaN where nothing is seen.
      flow: at the measured points of the objects [px/frame].
      moments: centroids and equivalent radii [px] of the silhouettes, or of what of them lies within ``Measured.planes``.
      background: flow at the measured points beside the objects [px/frame].
      bad: candidates that diverged.
      whole: centroids and equivalent radii of whole silhouettes [px].
    """

    reach: Float[np.ndarray, "batch frames objects directions"]
    flow: Float[np.ndarray, "batch intervals objects points 2"]
    moments: Float[np.ndarray, "batch frames objects 3"]
    background: Float[np.ndarray, "batch intervals places 2"]
    bad: np.ndarray
    whole: Float[np.ndarray, "batch frames objects 3"]

    @property
    def parts(self) -> Parts:
        """All that measurements are compared with."""
        return Parts(self.reach, self.flow, self.moments, self.background)


def _plain_function(shapes: tuple[Shape, ...], arrays: Arrays, image: tuple[int, int]):
    placed = place(shapes, arrays, image)
    normals = jnp.asarray(directions(DIRECTIONS), placed.centre.dtype)
    middle = 0.5 * image[0] * normals[:, 0] + 0.5 * image[1] * normals[:, 1]
    return jnp.stack([support_of(shape, placed, n, normals) for n, shape in enumerate(shapes)], 2) + middle


@functools.partial(jit_quickly, static_argnums=(0, 3, 4))
def _predict(shapes, arrays, pixels, image, count: int, planes=None):
    """Outlines, moments of the whole, flow at ``pixels``, and moments of what ``planes`` leave.

    ``count``: directions in which effects change outlines; 0 where none does. ``planes``: None where effects change what they
    leave, too, or there are none.
    """
    whole, flow = whole_function(shapes, arrays, image), point_flow_function(shapes, arrays, pixels, image)
    if count:
        return outline_function(shapes, arrays, image, count), whole, flow, whole
    told = (_plain_function(shapes, arrays, image),)
    if planes is None:
        return told, whole, flow, whole
    contact = outline_function(shapes, arrays, image, min(MANY))[1]
    return told, whole, flow, within_function(whole, planes, contact)


class Predictor:
    """Predictions for one clip.

    Args:
      shapes: the scene kind.
      pixels: points of each object at which the flow was measured [px]; the last frame's are not used.
      places: points beside the objects at which the flow was measured [px].
      image: (width, height) [px].
      fps: frames a second.
      blur: how far from an outline the flow beside it is still much like the object's [px].
      drawn: whether outlines draw the flow along, as they do where it was measured.
      shared: by how much centroids and equivalent radii fall short for each pixel by which masks are too fat, where these
        border on what lies behind them [px/px]; None: by nothing.
      planes: half planes within which masks are known, as ``Measured`` has them.
    """

    def __init__(
        self,
        shapes: tuple[Shape, ...],
        pixels: Float[np.ndarray, "frames objects points 2"],
        places: Float[np.ndarray, "places 2"],
        image: tuple[int, int],
        fps: float,
        blur: float = 0.0,
        drawn: bool = False,
        shared: Float[np.ndarray, "frames objects 3"] | None = None,
        planes: Float[np.ndarray, "frames objects 3"] | None = None,
    ):
        self.shapes, self.pixels, self.places, self.image, self.fps = shapes, pixels, places, image, fps
        self.blur, self.drawn, self.shared = blur, drawn, shared
        self.planes = None
        if planes is not None and np.isfinite(planes).any():
            self.planes = planes.astype(np.float32)

    @classmethod
    def of(cls, measured: Measured, shapes: tuple[Shape, ...], image: tuple[int, int], fps: float) -> Predictor:
        """Of all that was measured of a clip."""
        m = measured
        return cls(shapes, m.pixels, m.places, image, fps, m.blur, m.drawn, m.shared, m.planes)

    def __call__(self, poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch) -> Prediction:
        """The prediction for ``poses`` (of ``Simulator.rollout``) seen with the camera and effects of ``batch``."""
        bad = np.logical_not(np.isfinite(poses).all((1, 2, 3)))
        poses = np.where(bad[:, None, None, None], [0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 0.0], poses)
        seen = acting.apparent(poses, batch, self.fps)
        count = directions_for(batch, DIRECTIONS) if acting.changes_outlines(batch) else 0
        if count and self.planes is not None:
            count = max(count, min(MANY))
        bent = straight_pixels(seen, batch, self.pixels, self.image, self.fps) if bends(batch) else None
        told, whole, flow, within = self._predicted(seen, batch, self.pixels[None] if bent is None else bent[0], count)
        if bent is not None:
            flow = bent_flow(flow, bent[1], self.pixels, batch, self.image, self.fps)
        flow = flow[:, :-1]
        reach = told[0]
        if count:
            # Of a few rows at a time, which a core's cache holds, arrays in many directions take half as long.
            rows = [slice(first, first + CACHED) for first in range(0, len(seen), CACHED)]
            changed = [self._changed([part[one] for part in (*told, whole)], batch[one], count) for one in rows]
            reach, whole, within = (np.concatenate(part) for part in zip(*changed, strict=True))
        if self.drawn:
            flow = drawn_along(flow, whole)
        background = self._background(batch, len(poses), poses.shape[1])
        wide = acting.overdrawn(batch)
        if wide is not None and (wide > 0).any():
            beside = self._beside(told[0], directions(count)) * np.minimum(wide, 1.0)[:, None, None, None]
            around = background[:, np.arange(flow.shape[1])[:, None, None], self._nearest]
            flow = flow + beside[..., None] * (around - flow)
            if self.shared is not None:
                within = within - np.maximum(wide, 0.0)[:, None, None, None] * self.shared
        return Prediction(reach, flow, within, background, bad, whole)

    def _changed(self, told: Sequence[np.ndarray], batch: SceneBatch, count: int) -> tuple[np.ndarray, ...]:
        """Reach, and moments of the whole and of what planes leave, once effects have changed the outlines of some rows."""
        reach, contact, facing, scale, whole = told
        focal = focal_length(batch, self.image)
        rate = np.gradient(reach, axis=1) if reach.shape[1] > 1 else np.zeros_like(reach)
        normals = directions(count)
        view = OutlineView(
            reach, contact, rate, normals, facing, scale, focal, self.image, self.fps, batch.shapes, batch.size
        )
        change = acting.outline_change(batch, view)
        moved, hidden = changed_polygon(batch, view, change)
        whole = changed_moments(whole, view, change, moved, hidden)
        return (reach + change)[..., :: count // DIRECTIONS], whole, self._within(whole, moved, hidden)

    def _within(self, whole: np.ndarray, moved: np.ndarray, hidden: np.ndarray | None) -> np.ndarray:
        """Moments of what planes leave of a few rows."""
        if self.planes is None:
            return whole
        # One size is compiled.
        rows = (whole, moved) if hidden is None else (whole, moved, hidden)
        full = [np.concatenate([one, np.repeat(one[:1], CACHED - len(one), 0)]).astype(np.float32) for one in rows]
        return np.asarray(moments_within(full[0], self.planes, *full[1:]), np.float64)[: len(whole)]

    @functools.cached_property
    def _nearest(self) -> Int[np.ndarray, "intervals objects points"]:
        """The place beside the objects that is nearest to each of their points."""
        away = self.pixels[:-1, :, :, None] - self.places
        return np.square(away).sum(-1).argmin(-1)

    def _beside(
        self, reach: Float[np.ndarray, "batch frames objects directions"], normals: Float[np.ndarray, "directions 2"]
    ) -> Float[np.ndarray, "batch intervals objects points"]:
        """Whether points of the objects' masks lie beside their silhouettes, from 0 to 1."""
        across = self.pixels[:-1] @ normals.T
        # The silhouette is convex: what lies beyond the tangent in any direction is not of it.
        beyond = np.stack([(across - row[:-1, :, None]).max(-1) for row in reach])
        return scipy.special.expit((beyond - self.blur) / EDGE)

    def _predicted(self, seen: np.ndarray, batch: SceneBatch, pixels: np.ndarray, count: int):
        """``_predict`` of rows, ``ROWS`` at a time; ``pixels`` are one row for all, or each one's own."""
        pixels, found = pixels.astype(np.float32), []
        planes = None if count else self.planes
        for first in range(0, len(seen), ROWS):
            rows = slice(first, min(first + ROWS, len(seen)))
            device = padded(seen[rows], batch[rows], (ROWS,))
            # The same program serves both.
            own = pixels[rows] if len(pixels) == len(seen) else pixels
            own = np.concatenate([own, np.repeat(own[:1], ROWS - len(own), 0)])
            # What follows is prepared while this is computed.
            found.append((rows.stop - first, _predict(self.shapes, device, own, self.image, count, planes)))
        parts = [jax.tree.map(lambda a, n=n: np.asarray(a, np.float64)[:n], one) for n, one in found]
        return parts[0] if len(parts) == 1 else jax.tree.map(lambda *a: np.concatenate(a), *parts)

    def warm(self, frames: int) -> None:
        """Compiles predictions of clips of so many frames."""
        count, pixels = len(self.shapes), np.repeat(self.pixels[None].astype(np.float32), ROWS, 0)
        for directed in (DIRECTIONS, 0, *MANY):
            poses = np.tile([0.0, 2.0, 0.5, 1.0, 0.0, 0.0, 0.0], (ROWS, frames, count, 1))
            place, angle = np.tile([0.0, -2.0, 4.0], (ROWS, 1)), np.ones(ROWS)
            arrays = (poses, np.full((ROWS, count, 3), 0.3), place, angle, angle)
            planes = None if directed else self.planes
            ready = tuple(jnp.asarray(a, jnp.float32) for a in arrays)
            _predict(self.shapes, ready, pixels, self.image, directed, planes)

    def _background(self, batch: SceneBatch, count: int, frames: int) -> np.ndarray:
        """Flow of what stands still, at ``places``: of the floor, or of infinity above the horizon."""
        if not acting.moves_camera(batch):
            return np.zeros((count, frames - 1, len(self.places), 2))
        axes, where = acting.camera_path(batch, frames, self.fps)
        focal = focal_length(batch, self.image)[:, None]
        x = (self.places[:, 0] - self.image[0] / 2) / focal
        y = -(self.places[:, 1] - self.image[1] / 2) / focal
        ray = np.stack([x, y, -np.ones_like(x)], -1)
        world = np.einsum("btij,bpj->btpi", axes, ray)
        down = -world[..., 2]
        far = 50.0
        reach = np.where(down > 1e-3, where[:, :, None, 2] / np.maximum(down, 1e-3), far)
        point = where[:, :, None] + np.clip(reach, 0.05, far)[..., None] * world
        later = np.einsum("btji,btpj->btpi", axes[:, 1:], point[:, :-1] - where[:, 1:, None])
        depth = np.maximum(-later[..., 2], 0.02)
        u = focal[:, :, None] * later[..., 0] / depth + self.image[0] / 2
        v = -focal[:, :, None] * later[..., 1] / depth + self.image[1] / 2
        return np.stack([u, v], -1) - self.places
