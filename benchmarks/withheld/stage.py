"""A base scene with its base motion, and films of it with effects."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from benchmarks.clips import clip as clips
from benchmarks.clips import rotation
from benchmarks.clips.bullet import Entry, Motion, bodies
from benchmarks.clips.camera import Camera
from benchmarks.withheld import physics, solids
from benchmarks.withheld.effect import Effect, named
from benchmarks.withheld.film import Film
from benchmarks.withheld.track import RATE, Track
from benchmarks.withheld.view import FPS, view_of

SIZE, FRAMES = (480, 320), 30
EXTRA = 8  # frames simulated beyond the last, for clips that lose some
_FORCES = ("drag", "magnus", "wind", "push", "slope", "friction_patch", "offset_com", "hidden_obstacle")
_STRANGE = ("spring", "periodic_force", "growing_force", "gravity_flip", "vortex", "shrinking", "teleport")
MOVING = frozenset([*_FORCES, *_STRANGE])


@dataclass(frozen=True)
class Stage:
    """A scene without effects; kind: what its first object does."""

    entries: list[Entry]
    kind: str

    @cached_property
    def objects(self) -> list[Entry]:
        """Its objects' entries."""
        return bodies(self.entries)

    @cached_property
    def camera(self) -> Camera:
        """Its camera, without effects."""
        return Camera.of(self.entries, *SIZE)

    @cached_property
    def track(self) -> Track:
        """Its motion without effects."""
        return self.run(())

    @cached_property
    def base(self) -> Film:
        """Its film without effects."""
        return self.film(())

    def run(self, effects: tuple[Effect, ...]) -> Track:
        """Its motion with effects."""
        return physics.simulate(self.entries, effects, (FRAMES - 1 + EXTRA) / FPS + 0.04)

    def film(self, effects: tuple[Effect, ...]) -> Film:
        """Its film with effects."""
        track = self.run(effects) if any(e.name in MOVING for e in effects) else self.track_of_base(effects)
        drawn = [solids.of(entry) for entry in self.objects]
        form = named(effects, "shape")
        if form is not None and form.target is not None:
            how = form.hidden
            drawn[form.target] = solids.another(
                self.objects[form.target], how["form"], how["strength"], np.asarray(how["lean"])
            )
        return Film(track, view_of(self.camera, effects, FRAMES), tuple(drawn))

    def track_of_base(self, effects: tuple[Effect, ...]) -> Track:
        """The base motion, with nothing acting, for effects that leave motion alone."""
        track = self.track
        acting = np.zeros((len(effects), *track.speed.shape), bool)
        return Track(track.position, track.quaternion, track.scale, track.speed, track.touched, track.gap, acting, None)

    def fault(self) -> str | None:
        """Why the scene without effects is of no use, or None."""
        steps = (np.arange(FRAMES) * RATE / FPS).astype(int)
        track = self.track
        motion = Motion(track.position[steps], track.quaternion[steps], track.touched, track.gap)
        return clips.motion_fault(self.entries, self.kind, motion, self.camera)


def moved_objects(a: Film, b: Film) -> float:
    """Largest distance between two films' outlines over frames, objects and 16 directions, pixels."""
    return float(np.abs(a.outlines - b.outlines).max())


def moved_picture(a: Film, b: Film) -> float:
    """Largest displacement of the floor's points that show in `a` at the start, over frames, pixels."""
    columns, rows = np.linspace(0, a.view.width, 13), np.linspace(0, a.view.height, 9)
    image = np.stack(np.meshgrid(columns, rows), -1)
    way = a.view.rays(image) @ a.view.turn[0].T
    origin = a.view.origin[0]
    spots = origin + way * (-origin[2] / np.minimum(way[..., 2], -0.05))[..., None]
    moved = [
        np.linalg.norm(a.view.project(spots, k) - b.view.project(spots, k), axis=-1).max() for k in range(a.frames)
    ]
    return float(max(moved))


def film_fault(film: Film, entries: list[Entry]) -> str | None:
    """Why a film's pictures disqualify it, or None: objects in view, not too small, not hidden, above the floor."""
    reach = film.outlines
    left, right, top, bottom = -reach[..., 8], reach[..., 0], -reach[..., 12], reach[..., 4]
    width, height = right - left, bottom - top
    if not np.isfinite(reach).all() or np.abs(reach).max() > 5000:
        return "unstable"
    if min(width.min(), height.min()) < 12:
        return "too small"
    inside = _overlap(left, right, film.view.width) * _overlap(top, bottom, film.view.height)
    if (inside < 0.75 * width * height).any():
        return "out of view"
    steps = np.clip((film.view.times * RATE).astype(int), 0, len(film.track.position) - 1)
    centre = film.track.position[steps]
    away = -np.einsum("fni,fi->fn", centre - film.view.origin[:, None], film.view.turn[:, :, 2])
    if away.min() < 0.8:
        return "too close to the camera"
    objects = bodies(entries)
    for i, entry in enumerate(objects):
        if (centre[:, i, 2] < 0.3 * min(solids.half_extents(entry)) - 0.4 * np.abs(centre[:, i, :2]).max()).any():
            return "below the floor"
    if len(objects) > 1 and _least_visible(film) < 0.5:
        return "hidden"
    return None


def _overlap(
    low: Float[np.ndarray, "frames objects"], high: Float[np.ndarray, "frames objects"], size: int
) -> Float[np.ndarray, "frames objects"]:
    return np.clip(np.minimum(high, size) - np.maximum(low, 0), 0, None)


def _least_visible(film: Film) -> float:
    least = 1.0
    for frame in range(film.frames):
        ids = film.cast(frame, 0.25).ids
        for i in range(len(film.solids)):
            alone = (film.cast(frame, 0.25, only=i).ids > 0).sum()
            least = min(least, float((ids == i + 1).sum() / max(alone, 1)))
    return least


def resting(entry: Entry) -> bool:
    """Whether an object starts touching the flat floor."""
    height = rotation.half_height(entry, np.asarray(entry["state"]["orientation"], float))
    return abs(entry["state"]["position"][2] - height) < 1e-6
