"""A region of the floor with another friction."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.closing import glance, rim_speed
from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Motion, Start

LATE, WIDE = (0, 1, 2, 4, 8), (1, 2, 4, 8)
"""How many frames late an object may be at the middle of a patch, and how many it may take from there to the border."""


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
        away = np.linalg.norm(motion.position[..., :2] - values[:, None, :2], axis=-1)
        return np.where(away < values[:, 2:3], values[:, 3:4], np.nan)

    def idle(self, motion: Motion, target: int, values: np.ndarray) -> float:
        away = np.linalg.norm(motion.position[..., :2] - values[:, None, :2], axis=-1)
        # In a collision spin turns into speed.
        closing = np.linalg.norm(motion.velocity, axis=-1) + rim_speed(motion)
        return glance(np.abs(away - values[:, 2:3]), closing.max(-1, keepdims=True))

    def starts(self, view: FitView, target: int) -> list[Start]:
        found = []
        for n in range(len(view.batch.shapes)):
            path = view.poses[:, n, :2]
            length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
            if length[-1] < 0.2 or view.on_floor[:, n].sum() < 5:
                continue
            radius = float(np.clip(0.2 * length[-1], 0.08, 0.6))
            own = float(view.batch.friction[0, n, 0])
            for at in np.linspace(0.1, 1.0, 7) * length[-1]:
                centre = [np.interp(at, length, path[:, k]) for k in range(2)]
                for wide in (1.0, 2.0):
                    for friction in (0.25 * own, own + 0.5):
                        found.append(np.array([*centre, wide * radius, friction]))
        return [_start(v, len(found)) for v in found]

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
        places = max(len(self.starts(view, target)), 1)
        return [_start(v, places) for v in found]

    def window(self, view: FitView, target: int, values: np.ndarray) -> tuple[int, int] | None:
        inside = self._inside(view, values)[:, self.struck(view, values)]
        frames = np.nonzero(inside)[0]
        return (int(frames[0]), int(frames[-1])) if len(frames) else None

    def struck(self, view: FitView, values: np.ndarray) -> int:
        return int(self._inside(view, values).sum(0).argmax())

    def _inside(self, view: FitView, values: np.ndarray) -> np.ndarray:
        moving = np.linalg.norm(view.velocity, axis=-1) > 0.03
        return (np.linalg.norm(view.poses[..., :2] - values[:2], axis=-1) < values[2]) & view.on_floor & moving


def _start(values: np.ndarray, places: int) -> Start:
    """Where to begin with a patch that might lie at so many ``places``: the larger, the less is known of it."""
    radius = values[2]
    return Start(values, width=np.array([0.5 * radius, 0.5 * radius, 0.4 * radius, 0.4]), places=places)
