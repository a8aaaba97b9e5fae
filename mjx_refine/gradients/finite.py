"""Derivatives that are not numbers are told, never passed on."""

from __future__ import annotations

import numpy as np


class DerivativeError(ArithmeticError):
    """A rollout or one of its derivatives is not finite at this point; the message names the parameters."""


def require_finite(values: np.ndarray, derivatives: np.ndarray, names: tuple[str, ...]) -> None:
    """Checks a value and its derivatives (parameters first).

    Raises:
      DerivativeError: something in either is NaN or infinite.
    """
    if not np.isfinite(values).all():
        raise DerivativeError(f"the rollout or its view is not finite{_since(values)}; expected a scene that is stable")
    bad = np.logical_not(np.isfinite(derivatives.reshape(len(names), -1)).all(1)).reshape(-1)
    if bad.any():
        which = ", ".join(name for name, wrong in zip(names, bad.tolist(), strict=True) if wrong)
        since = _since(derivatives[bad].swapaxes(0, 1)) if derivatives.ndim > 1 else ""
        raise DerivativeError(f"the derivative in {which} is not finite{since}; use differences or a population here")


def _since(array: np.ndarray) -> str:
    """From which entry of the first axis on."""
    if array.ndim == 0:
        return ""
    wrong = ~np.isfinite(array.reshape(len(array), -1)).all(1)
    return f" from row {int(np.argmax(wrong))} of {len(array)} on"
