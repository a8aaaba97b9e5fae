"""Derivatives of several clips' residuals, each clip's over as long a step as it takes not to tell a jag instead."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.pace import OWN, STEPS, probe, tells_jags, without_jags
from mjx_refine.diagnosis.joint.hypothesis import JointHypothesis

Sizes = Sequence[Any]
"""Of differences, a clip each: one for all of its numbers, or one for each; None where its derivatives are not asked for."""

Residuals = Callable[[np.ndarray], tuple[list[np.ndarray], np.ndarray]]
Jacobians = Callable[[np.ndarray, list[np.ndarray], Sizes], list[Any]]


class JointDifferences:
    """As ``pace.Differences``, of several clips: whether a number's short difference tells a jag, each clip says by itself.

    Args:
      hypothesis: of all clips.
      residuals: of points, one a row, (B, R) a clip, and their costs.
      jacobians: at a point with its residuals, by differences of a size, (R, part) a clip.
    """

    def __init__(self, hypothesis: JointHypothesis, residuals: Residuals, jacobians: Jacobians):
        self.hypothesis, self.residuals, self._jacobians = hypothesis, residuals, jacobians
        self._sizes: list[np.ndarray] | None = None

    def of(
        self, z: Float[np.ndarray, "dimension"], base: list[np.ndarray], size: float
    ) -> list[Float[np.ndarray, "residuals part"]]:
        """By differences of this size; ``OWN``: of the sizes that ``surest`` found last."""
        if size == OWN and self._sizes is None:
            return self.surest(z, base)
        return self._jacobians(z, base, self._sizes if size == OWN and self._sizes else [size] * len(base))

    def tried(self) -> tuple[float, ...]:
        """The sizes to be tried one after the other where one leads no further."""
        plain = self._sizes is not None and all(bool(np.all(sizes == STEPS[0])) for sizes in self._sizes)
        return STEPS if plain else (OWN, *STEPS)

    def surest(
        self, z: Float[np.ndarray, "dimension"], base: list[np.ndarray]
    ) -> list[Float[np.ndarray, "residuals part"]]:
        """By the smallest differences; of the clips, and the numbers, of which these tell a jag by longer ones."""
        told = self._jacobians(z, base, [STEPS[0]] * len(base))
        sizes = [np.full(slopes.shape[1], STEPS[0]) for slopes in told]
        point = probe(z, self.hypothesis.bounds)
        rows, _ = self.residuals(point[None])
        steps = self.hypothesis.split(point - z)
        jagged = [tells_jags(t @ step, row[0] - b) for t, step, row, b in zip(told, steps, rows, base, strict=True)]
        for shorter, size in itertools.pairwise(STEPS) if any(jagged) else ():
            longer = self._jacobians(z, base, [size if one else None for one in jagged])
            for c in (c for c, one in enumerate(jagged) if one):
                told[c], sizes[c] = without_jags(told[c], sizes[c], shorter, longer[c], size)
        self._sizes = sizes
        return told
