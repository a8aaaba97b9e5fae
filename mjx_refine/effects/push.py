"""One brief impulse from outside."""

from __future__ import annotations

import numpy as np

from mjx_refine.effects.kind import EffectKind, EffectParameter, FitView, Loads, Motion, Start, of_target

DURATION = 1.0 / 60.0
"""How long it lasts [s]."""


class Push(EffectKind):
    """An impulse through the centre, spread evenly over 1/60 s from ``time`` on."""

    name = "push"
    sentence = "{target} is pushed once from outside"
    experiment = (
        "Film the same motion again: a push will not come again at the same moment, a patch or an obstacle will."
    )
    targeted = True
    physical = True
    parameters = (
        EffectParameter("time", "s", 0.03, 0.0, 1e3, 0.5, None),
        EffectParameter("x", "N s", 1.0, -1e4, 1e4),
        EffectParameter("y", "N s", 1.0, -1e4, 1e4),
        EffectParameter("z", "N s", 1.0, -1e4, 1e4),
    )

    def loads(self, motion: Motion, target: int, values: np.ndarray) -> Loads | None:
        step = motion.step
        began = values[:, 0]
        # The part of this step that the push covers, so that the path is smooth in the time of the push.
        covered = np.minimum(motion.time + step, began + DURATION) - np.maximum(motion.time, began)
        share = np.clip(covered, 0.0, None) / step / DURATION
        if not share.any():
            return None
        force = of_target(motion.batch, target, values[:, 1:4] * share[:, None])
        return force, np.zeros_like(force)

    def idle(self, motion: Motion, target: int, values: np.ndarray) -> float:
        until = values[:, 0] - motion.time
        return float(np.where(until > 0, until, np.where(until > -DURATION, 0.0, np.inf)).min())

    def starts(self, view: FitView, target: int) -> list[Start]:
        onsets = np.arange(0.5, view.frames - 1.5, 1.0) / view.fps
        mass = view.mass(target)
        width = np.array([0.7 / view.fps, mass, mass, mass])
        columns = tuple((k, 0.2 * mass) for k in (1, 2, 3))
        return [Start(np.array([t, 0.0, 0.0, 0.0]), columns, width, places=len(onsets)) for t in onsets]

    def window(self, view: FitView, target: int, values: np.ndarray) -> tuple[int, int] | None:
        # The frame that is nearest to where the path bends, and its neighbours.
        nearest = int(np.clip(np.round(values[0] * view.fps), 0, view.frames - 1))
        return max(nearest - 1, 0), min(nearest + 1, view.frames - 1)
