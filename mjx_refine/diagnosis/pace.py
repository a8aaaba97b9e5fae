"""How Levenberg-Marquardt goes on: how strongly steps are damped, which differences tell derivatives, when it is done."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

STEPS = (0.002, 0.02, 0.2)
"""Of finite differences, in prior widths: the first follows what is smooth, the others see over the jags of contacts, and
are tried where it leads no further."""

DAMPINGS = np.array([0.03, 0.3, 1.0, 10.0, 100.0])


def damped(
    z: Float[np.ndarray, "dimension"],
    gradient: Float[np.ndarray, "dimension"],
    curvature: Float[np.ndarray, "dimension dimension"],
    factor: float,
    low: Float[np.ndarray, "dimension"],
    high: Float[np.ndarray, "dimension"],
) -> Float[np.ndarray, "dimension"]:
    """Where a damped step leads within the bounds (Marquardt 1963)."""
    free = ~(((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0)))
    step = np.zeros(len(z))
    matrix = curvature[np.ix_(free, free)]
    matrix = matrix + factor * np.diag(np.maximum(0.01 * np.diag(matrix), 1.0))
    step[free] = -np.linalg.solve(matrix, gradient[free])
    step *= min(1.0, 12.0 / max(np.abs(step).max(initial=0.0), 1e-12))
    return np.clip(z + step, low, high)


def updated(
    jacobian: Float[np.ndarray, "residuals dimension"],
    step: Float[np.ndarray, "dimension"],
    change: Float[np.ndarray, "residuals"],
) -> Float[np.ndarray, "residuals dimension"]:
    """The derivatives with the least change that makes them predict what a step did (Broyden 1965)."""
    return jacobian + np.outer(change - jacobian @ step, step) / max(float(step @ step), 1e-12)


class Pace:
    """Of one fit.

    Attributes:
      size: of finite differences, one of ``STEPS``.
      damping: multiplies ``DAMPINGS``.
      failed: steps in a row that gained next to nothing.
    """

    def __init__(self):
        self.size, self.damping, self.failed = STEPS[0], 1.0, 0

    def done(self, gain: float, best: int, cost: float) -> bool:
        """Takes a step's gain, which of ``DAMPINGS`` it had and the cost afterwards; True where no other helps either."""
        if gain > 0:
            self.damping = float(np.clip(self.damping * DAMPINGS[best], 1e-3, 1e3))
        if gain >= 0.05 + 1e-4 * cost:
            self.failed = 0
            return False
        self.failed += 1
        if self.failed > len(STEPS):
            return True
        # First shorter steps, then other derivatives.
        shorter = self.failed == 1 and gain <= 0
        self.damping = min(300.0 * self.damping, 1e3) if shorter else 1.0
        self.size = self.size if shorter else STEPS[(STEPS.index(self.size) + 1) % len(STEPS)]
        return False
