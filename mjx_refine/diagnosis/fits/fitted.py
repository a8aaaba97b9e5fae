"""Where least squares ended, and the prior that it was fitted with."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.nodes import HELD
from mjx_refine.search.residuals import slowed


@dataclasses.dataclass(frozen=True)
class Fit:
    """Where least squares ended.

    Attributes:
      hypothesis: what was fitted.
      z: the point.
      cost: half the sum of squares, with the prior.
      data: ditto without the prior.
      jacobian: of the residuals.
      residual: at the point, in noise widths times the root of their weight.
      evidence: logarithm of the hypothesis' probability, up to a constant of the clip (Laplace; MacKay 2003, ch. 28).
      ended: whether least squares ended by themselves; if not, they were interrupted or given up, and ``jacobian`` is rough.
    """

    hypothesis: Hypothesis
    z: Float[np.ndarray, "dimension"]
    cost: float
    data: float
    jacobian: Float[np.ndarray, "residuals dimension"]
    residual: Float[np.ndarray, "residuals"]
    evidence: float
    ended: bool = True

    @property
    def ordinary(self) -> tuple[Hypothesis, Float[np.ndarray, "1 dimension"]]:
        """The hypothesis without its effects, and the point in it."""
        plain = dataclasses.replace(self.hypothesis, terms=())
        return plain, self.z[None, : plain.dimension]

    @property
    def gradient(self) -> Float[np.ndarray, "dimension"]:
        """Of the cost."""
        price, slope = prior(self.hypothesis, self.z)
        return self.jacobian.T @ self.residual + slope * price

    @property
    def curvature(self) -> Float[np.ndarray, "dimension dimension"]:
        """Of the cost, by Gauss and Newton."""
        return self.jacobian.T @ self.jacobian + np.diag(prior(self.hypothesis, self.z)[1] ** 2)


class Explained:
    """A fit with effects: what they are."""

    fit: Any

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(t.name for t in self.fit.hypothesis.terms)

    @property
    def targets(self) -> tuple[int, ...]:
        return tuple(t.target for t in self.fit.hypothesis.terms)

    @property
    def effects(self) -> tuple[tuple[str, int], ...]:
        """Name and target of every effect."""
        return tuple(zip(self.names, self.targets, strict=True))


def prior(hypothesis: Hypothesis, z: Float[np.ndarray, "*batch dimension"]) -> tuple[np.ndarray, np.ndarray]:
    """The prior as residuals, and their derivatives in z: heavy-tailed for base parameters, normal for effects'."""
    tails = hypothesis.tails
    heavy = np.isfinite(tails)
    tail = np.where(heavy, tails, 1.0)
    residual = np.where(heavy, slowed(z, tail), z)
    loose = hypothesis.loose
    slope = np.where(np.abs(z) > 1e-6, np.abs(z) / np.maximum((1 + (z / tail) ** 2) * np.abs(residual), 1e-12), 1.0)
    slope = np.where(heavy, np.maximum(slope, 0.1), 1.0)
    return np.where(loose, HELD * z, residual), np.where(loose, HELD, slope)
