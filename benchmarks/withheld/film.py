"""Masks, exact flow and pictures of a track seen through a view: a ray tracer of its own."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from benchmarks.withheld.solids import Solid
from benchmarks.withheld.track import Track
from benchmarks.withheld.view import View

OUTLINE = np.stack([np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8)], -1)


@dataclass(frozen=True)
class Hits:
    """First hits of one frame's rays.

    Fields:
      ids: 0 background, i + 1 object i. depth: along the optical axis, m (inf: background).
      local: hit point in the object's own frame, m (0 on the background).
    """

    ids: Int[np.ndarray, "height width"]
    depth: Float[np.ndarray, "height width"]
    local: Float[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Film:
    """A clip before it is written: where things are, how they look, and what they are seen with."""

    track: Track
    view: View
    solids: tuple[Solid, ...]

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return len(self.view.times)

    @cached_property
    def outlines(self) -> Float[np.ndarray, "frames objects 16"]:
        """How far each object reaches in 16 directions of the picture, pixels; directions go from x to y (down)."""
        out = np.zeros((self.frames, len(self.solids), len(OUTLINE)))
        for frame, (i, solid) in itertools.product(range(self.frames), enumerate(self.solids)):
            out[frame, i] = (self.view.show(self.track, i, solid.points, frame) @ OUTLINE.T).max(0)
        return out

    def grid(self, scale: float) -> Float[np.ndarray, "height width 2"]:
        """Image coordinates of the pixel centres of a picture `scale` times as fine."""
        rows, columns = np.mgrid[0 : round(self.view.height * scale), 0 : round(self.view.width * scale)]
        return np.stack([columns + 0.5, rows + 0.5], -1) / scale

    @cached_property
    def _rays(self) -> dict[float, tuple[np.ndarray, np.ndarray]]:
        return {}

    def rays(self, scale: float) -> tuple[Float[np.ndarray, "height width 2"], Float[np.ndarray, "height width 3"]]:
        """The grid and the camera's rays through it, kept."""
        if scale not in self._rays:
            grid = self.grid(scale)
            self._rays[scale] = (grid, self.view.rays(grid))
        return self._rays[scale]

    def cast(self, frame: int, scale: float = 1.0, only: int | None = None) -> Hits:
        """First hits of the rays through a frame's pixel centres; `only`: as if that object were alone."""
        grid, rays = self.rays(scale)
        ids = np.zeros(grid.shape[:2], np.int32)
        depth, local = np.full(ids.shape, np.inf), np.zeros((*ids.shape, 3))
        for i, solid in enumerate(self.solids):
            if only not in (None, i):
                continue
            reach = self.outlines[frame, i]
            left, right, top, bottom = -reach[8], reach[0], -reach[12], reach[4]
            # Sampled points of a curved solid lie a little inside its outline.
            margin = 2 + 0.02 * max(right - left, bottom - top)
            low = np.floor((np.array([top, left]) - margin) * scale).clip(0).astype(int)
            high = np.ceil((np.array([bottom, right]) + margin) * scale).clip(0).astype(int)
            part = (slice(low[0], high[0]), slice(low[1], high[1]))
            if rays[part].size == 0:
                continue
            place, turn, size = self.track.at(self.view.row_time(grid[part][:, 0, 1], frame), i)
            origin = np.einsum("hji,hj->hi", turn, self.view.origin[frame] - place) / size[:, None]
            way = np.matmul(rays[part] @ self.view.turn[frame].T, turn) / size[:, None, None]
            met = solid.meet(np.broadcast_to(origin[:, None], way.shape), way)
            nearer = (met > 0) & (met < depth[part])
            ids[part] = np.where(nearer, i + 1, ids[part])
            depth[part] = np.where(nearer, met, depth[part])
            points = origin[:, None] + np.where(nearer, met, 0)[..., None] * way
            local[part] = np.where(nearer[..., None], points, local[part])
        return Hits(ids, depth, local)

    def floor(self, frame: int, scale: float = 1.0) -> Float[np.ndarray, "height width 3"]:
        """Where a frame's rays meet the floor z = 0, m; rays above the horizon far away."""
        way = self.rays(scale)[1] @ self.view.turn[frame].T
        down = np.minimum(way[..., 2], -1e-3)
        return self.view.origin[frame] + way * (-self.view.origin[frame][2] / down)[..., None]

    def flow(self, frame: int, hits: Hits) -> Float[np.ndarray, "height width 2"]:
        """Exact flow of the surface points of a frame to the next one, pixels; the floor stands for all background."""
        grid = self.rays(1.0)[0]
        out = np.zeros_like(grid)
        still = hits.ids == 0
        view = self.view
        if not np.array_equal(view.turn[frame], view.turn[frame + 1]) or not np.array_equal(
            view.origin[frame], view.origin[frame + 1]
        ):
            out[still] = view.project(self.floor(frame)[still], frame + 1) - grid[still]
        for i in range(len(self.solids)):
            here = hits.ids == i + 1
            if here.any():
                out[here] = view.show(self.track, i, hits.local[here], frame + 1) - grid[here]
        return out


@dataclass(frozen=True)
class Paint:
    """Textures and light of a clip's pictures.

    Fields:
      ground: picture of the floor, GROUND m wide. stuff: solid texture of each object, (n, n, n, 3) grey levels.
      light: direction to the light, unit length.
    """

    ground: UInt8[np.ndarray, "n n 3"]
    stuff: tuple[Float[np.ndarray, "m m m 3"], ...]
    light: Float[np.ndarray, "3"]


GROUND = 16.0
GRAIN = 0.035  # m between the points of a solid texture


def paint(rng: np.random.Generator, objects: int) -> Paint:
    """Random textures with detail at several scales."""
    from benchmarks.clips import surfaces

    grey = rng.uniform(95, 150)
    tint = (grey, grey + rng.uniform(-15, 15), grey + rng.uniform(-15, 15))
    ground = surfaces.texture(rng, 2048, tint, 0, 320, rng.uniform(14, 22))
    stuff = []
    for _ in range(objects):
        size = 40
        volume = rng.uniform(60, 200, 3) + rng.normal(0, 16, (size, size, size, 3))
        coarse = rng.normal(0, 30, (10, 10, 10, 3))
        stuff.append((volume + coarse.repeat(4, 0).repeat(4, 1).repeat(4, 2)).clip(8, 247))
    turn = rng.uniform(-np.pi, np.pi)
    light = np.array([np.cos(turn), np.sin(turn), 2.0])
    return Paint(ground, tuple(stuff), light / np.linalg.norm(light))


def picture(film: Film, frame: int, look: Paint, rng: np.random.Generator) -> UInt8[np.ndarray, "height width 3"]:
    """RGB of a frame, drawn twice as fine and averaged, with the sensor's noise."""
    hits = film.cast(frame, 2.0)
    spots = film.floor(frame, 2.0)
    size = len(look.ground)
    place = ((spots[..., :2] / GROUND + 0.5) * size % size).astype(np.float32)
    image = cv2.remap(look.ground, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(
        np.float32
    )
    image *= cv2.resize(_shadow(film, frame, look.light), image.shape[1::-1])[..., None]
    for i, solid in enumerate(film.solids):
        here = hits.ids == i + 1
        if not here.any():
            continue
        local = hits.local[here]
        turn = film.track.at(film.view.times[frame], i)[1]
        lit = np.clip(solid.normal(local) @ turn.T @ look.light, 0, 1)
        image[here] = _sample(look.stuff[i], local) * (0.55 + 0.45 * lit)[:, None]
    small = cv2.resize(image, (film.view.width, film.view.height), interpolation=cv2.INTER_AREA)
    return (small + rng.normal(0, 1.2, small.shape)).clip(0, 255).astype(np.uint8)


def _sample(volume: Float[np.ndarray, "m m m 3"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Trilinear look-up, repeated over space."""
    size = len(volume)
    place = points / GRAIN + size / 2
    low = np.floor(place).astype(int)
    share = place - low
    out = np.zeros((len(points), 3))
    for corner in itertools.product((0, 1), repeat=3):
        weight = np.prod(np.where(corner, share, 1 - share), -1)
        x, y, z = ((low + corner) % size).T
        out += weight[:, None] * volume[x, y, z]
    return out


def _shadow(film: Film, frame: int, light: Float[np.ndarray, "3"]) -> Float[np.ndarray, "height width"]:
    """How bright the floor is: 1 in the light, less behind an object."""
    spots = film.floor(frame, 1.0)
    bright = np.ones(spots.shape[:2], np.float32)
    for i, solid in enumerate(film.solids):
        place, turn, size = film.track.at(film.view.times[frame], i)
        reach = float(np.linalg.norm(solid.points, axis=1).max()) * float(size) * 1.05
        beside = np.cross(place - spots, light)
        near = (beside**2).sum(-1) < reach**2
        if near.any():
            origin = (spots[near] - place) @ turn / size
            way = np.broadcast_to(light @ turn / size, origin.shape)
            met = solid.meet(origin, way)
            bright[near] = np.where(np.isfinite(met) & (met > 0), 0.62, bright[near])
    return cv2.GaussianBlur(bright, (0, 0), 1.0)


def measured_flow(pictures: list[UInt8[np.ndarray, "height width 3"]]) -> Float[np.ndarray, "steps height width 2"]:
    """Flow between consecutive pictures by OpenCV's DIS (Kroeger et al., ECCV 2016), medium preset."""
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY) for p in pictures]
    return np.stack([dis.calc(a, b, None) for a, b in itertools.pairwise(grey)])  # type: ignore[call-overload]
