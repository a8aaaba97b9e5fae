"""Derivatives of rollouts and of views in the coordinates of the unit box, and whether they can be trusted.

An object that exactly touches the floor at the start, a flat box above all, has wrong derivatives: its contacts open
and close with the last digit. Lifted by 0.1 mm it has right ones; nothing here does that, a scene is taken as it is.
"""

from typing import TYPE_CHECKING

from mjx_refine.gradients.check import Verdict, check
from mjx_refine.gradients.finite import DerivativeError

if TYPE_CHECKING:
    from mjx_refine.gradients.differentiator import Differentiator

__all__ = ["DerivativeError", "Differentiator", "Verdict", "check"]


def __getattr__(name: str) -> object:
    # MJX takes its time to import, and checks through C MuJoCo do without.
    if name == "Differentiator":
        from mjx_refine.gradients.differentiator import Differentiator

        return Differentiator
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
