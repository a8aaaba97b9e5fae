"""Derivatives of rollouts and of views in the coordinates of the unit box, and whether they can be trusted."""

from mjx_refine.gradients.check import Verdict, check
from mjx_refine.gradients.differentiator import Differentiator
from mjx_refine.gradients.finite import DerivativeError

__all__ = ["DerivativeError", "Differentiator", "Verdict", "check"]
