"""Loads of effects in a rollout, which asks for them step after step: what does not depend on the state is looked up once."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np
from jaxtyping import Float

from mjx_refine.batch import SceneBatch
from mjx_refine.effects.acting import acting_in
from mjx_refine.effects.kind import EffectKind, Loads, Motion


def has_loads(batch: SceneBatch) -> bool:
    """Whether an effect needs a look at the state in every step."""
    return bool(with_loads(batch))


def with_loads(batch: SceneBatch) -> tuple[str, ...]:
    """Names of the effects that need a look at the state in every step."""
    return tuple(kind.name for kind, _ in acting_in(batch) if _pushes(kind) or _rubs(kind))


class Loading:
    """Of one rollout.

    Args:
      batch: whose effects act, in the axes of the simulation.

    Attributes:
      lasting: what effects have worked out and will ask for again in later steps (``Motion.lasting``).
    """

    def __init__(self, batch: SceneBatch):
        self.lasting: dict[Hashable, Any] = {}
        acting = list(acting_in(batch))
        self._pushing = [(kind, e) for kind, e in acting if _pushes(kind)]
        self._rubbing = [(kind, e) for kind, e in acting if _rubs(kind)]
        self._looking = [(kind, e) for kind, e in acting if _pushes(kind) or _rubs(kind)]

    def idle(self, motion: Motion) -> float:
        """For how long the loads and the floor's friction surely stay as they are [s]."""
        least = np.inf
        for kind, e in self._looking:
            told = kind.idle(motion, e.target, e.values)
            if told == 0.0 or np.isnan(told):
                return told
            least = min(least, told)
        return least

    def loads(self, motion: Motion) -> Loads | None:
        """Forces and torques of all effects at one instant, or None where there are none."""
        told = None
        for kind, e in self._pushing:
            one = kind.loads(motion, e.target, e.values)
            if one is not None:
                told = one if told is None else (told[0] + one[0], told[1] + one[1])
        return told

    def floor_friction(self, motion: Motion) -> Float[np.ndarray, "batch objects"] | None:
        """Sliding friction with the floor where an effect changes it (NaN elsewhere), or None."""
        told = None
        for kind, e in self._rubbing:
            one = kind.floor_friction(motion, e.target, e.values)
            if one is not None:
                told = one if told is None else np.where(np.isnan(told), one, told)
        return told


def _pushes(kind: EffectKind) -> bool:
    return type(kind).loads is not EffectKind.loads


def _rubs(kind: EffectKind) -> bool:
    return type(kind).floor_friction is not EffectKind.floor_friction
