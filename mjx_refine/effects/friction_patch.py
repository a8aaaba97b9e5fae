"""A region of the floor with another friction."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.effects.closing import glance, rim_speed
from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Motion, Start

LATE, WIDE = (0, 1, 2, 4, 8), (1, 2, 4, 8)
"""How many frames late an object may be at the middle of a patch, and how many it may take from there to the border."""

BORDERS, BEYOND, LEAST = 8, 0.3, 0.05
"""At how many points of its path a body may come to a border, how far before and beyond its path one may lie, as a part of
its length, and the least radius [m]."""

STEP, WIDTH = 0.1, 0.1
"""Change of friction by which the linear look asks what a little of it does, and width of the prior of where a patch lies, and of
its radius, as a part of the path's length."""


class FrictionPatch(EffectKind):
    """Sliding friction with the floor is ``friction`` while the object's centre is above a disc."""

    name = "friction_patch"
    sentence = "the floor's friction changes in some region"
    experiment = (
        "Slide the object over the same place again, and beside it: a patch acts at its place, a push does not."
    )
    physical = True
    parameters = (
        EffectParameter("x", "m", 0.1, -1e4, 1e4, 0.0, None),
        EffectParameter("y", "m", 0.1, -1e4, 1e4, 0.0, None),
        EffectParameter("radius", "m", 0.15, 1e-3, 1e3, 0.4, None),
        EffectParameter("friction", "1", 0.4, 0.0, 10.0, 0.4, None),
    )

    def floor_friction(self, motion: Motion, target: int, values: np.ndarray) -> np.ndarray | None:
        beside = motion.position[..., :2] - values[:, None, :2]
        away = np.linalg.norm(beside, axis=-1)
        leaving = (beside * motion.velocity[..., :2]).sum(-1) / np.maximum(away, 1e-9)
        # The part of this step that is spent inside, so that the path is smooth in where the border is.
        travel = np.maximum(np.abs(leaving) * motion.step, 1e-9)
        inside = np.clip((values[:, 2:3] - away) / travel + (leaving < 0), 0.0, 1.0)
        own = motion.batch.friction[..., 0]
        return np.where(inside > 0, own + inside * (values[:, 3:4] - own), np.nan)

    def idle(self, motion: Motion, target: int, values: np.ndarray) -> float:
        away = np.linalg.norm(motion.position[..., :2] - values[:, None, :2], axis=-1)
        # In a collision spin turns into speed.
        closing = np.linalg.norm(motion.velocity, axis=-1) + rim_speed(motion)
        return glance(np.abs(away - values[:, 2:3]), closing.max(-1, keepdims=True))

    def starts(self, view: FitView, target: int) -> list[Start]:
        found: list[Start] = []
        for n in range(len(view.batch.shapes)):
            path = view.poses[:, n, :2]
            length = _lengths(path)
            if length[-1] < 0.2 or view.on_floor[:, n].sum() < 5:
                continue
            radius = float(np.clip(0.2 * length[-1], 0.08, 0.6))
            own = float(view.batch.friction[0, n, 0])
            for at in np.linspace(0.1, 1.0, 7) * length[-1]:
                centre = [np.interp(at, length, path[:, k]) for k in range(2)]
                for wide in (1.0, 2.0):
                    for friction in (0.25 * own, own + 0.5):
                        found.append(_start(np.array([*centre, wide * radius, friction]), view, n))
            # One that differs little: by how much, the linear look tells.
            for centre, radius in _stretches(path):
                found.append(_start(np.array([*centre, radius, own]), view, n, ((3, STEP),)))
        return found

    def crossed(self, view: FitView, target: int, frame: int) -> list[Start]:
        """Patches that an object crosses about ``frame``; none where it is not on the floor then."""
        near = slice(max(frame - 1, 0), frame + 2)
        if not view.on_floor[near, target].any():
            return []
        path, own = view.poses[:, target, :2], float(view.batch.friction[0, target, 0])
        pace = float(np.linalg.norm(np.diff(path[max(frame - 3, 0) : frame + 4], axis=0), axis=1).mean())
        found = [
            np.array([*path[int(np.clip(frame + late, 0, len(path) - 1))], np.clip(wide * pace, 0.03, 2.0), friction])
            for late in LATE
            for wide in WIDE
            for friction in (0.25 * own, own + 0.3, own + 0.8)
        ]
        return [_start(v, view, target) for v in found]

    def window(self, view: FitView, target: int, values: np.ndarray) -> tuple[int, int] | None:
        inside = self._inside(view, values)[:, self.struck(view, values)]
        frames = np.nonzero(inside)[0]
        return (int(frames[0]), int(frames[-1])) if len(frames) else None

    def struck(self, view: FitView, values: np.ndarray) -> int:
        return int(self._inside(view, values).sum(0).argmax())

    def _inside(self, view: FitView, values: np.ndarray) -> np.ndarray:
        moving = np.linalg.norm(view.velocity, axis=-1) > 0.03
        return (np.linalg.norm(view.poses[..., :2] - values[:2], axis=-1) < values[2]) & view.on_floor & moving


def _lengths(path: Float[np.ndarray, "frames 2"]) -> Float[np.ndarray, "frames"]:
    """How far along its path a body is in every frame [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def _stretches(path: Float[np.ndarray, "frames 2"]) -> list[tuple[np.ndarray, float]]:
    """Centres and radii of discs into which a path leads at one of some points, and out at another; before its first point and
    beyond its last one it goes on straight."""
    length = _lengths(path)
    inner = np.linspace(0.0, length[-1], BORDERS)[1:-1]
    points = [np.array([np.interp(at, length, path[:, k]) for k in range(2)]) for at in inner]
    ends = [
        a + BEYOND * length[-1] * (a - b) / max(float(np.linalg.norm(a - b)), 1e-9) for a, b in (path[:2], path[:-3:-1])
    ]
    points = [ends[0], *points, ends[1]]
    found = [
        (0.5 * (points[i] + points[j]), 0.5 * float(np.linalg.norm(points[j] - points[i])))
        for i in range(BORDERS)
        for j in range(i + 1, BORDERS)
        if (i, j) != (0, BORDERS - 1)
    ]
    return [(centre, radius) for centre, radius in found if radius > LEAST]


def _start(values: np.ndarray, view: FitView, target: int, columns: tuple[tuple[int, float], ...] = ()) -> Start:
    """Where to begin with a patch on an object's path: it may lie anywhere there, and be of any size."""
    wide = max(WIDTH * float(_lengths(view.poses[:, target, :2])[-1]), LEAST)
    # On any object's path, in either way.
    return Start(values, columns, np.array([wide, wide, wide, 0.4]), places=2 * len(view.batch.shapes))
