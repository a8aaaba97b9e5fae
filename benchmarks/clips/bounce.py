"""Restitution and the contact damping that gives it, in one formula, so that both engines start from one number."""

from __future__ import annotations

import numpy as np

STIFFNESS = 5000.0  # 1/s^2, the scene format's default


def damping(restitution: float, stiffness: float = STIFFNESS) -> float:
    """The (negative) contact damping of a linear spring-damper that rebounds at `restitution` (0 to 1)."""
    log = np.log(max(restitution, 0.02))
    return float(-2 * np.sqrt(stiffness) * -log / np.sqrt(np.pi**2 + log**2))


def restitution(damping: float, stiffness: float = STIFFNESS) -> float:
    """Speed ratio after half a period of a linear spring-damper: exp(-pi z / sqrt(1 - z^2)), z the damping ratio."""
    ratio = min(-damping / (2 * np.sqrt(stiffness)), 0.999)
    return float(np.exp(-np.pi * ratio / np.sqrt(1 - ratio**2)))
