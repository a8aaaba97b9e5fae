"""Refinement: landing by least squares, population search, and what a clip does not determine."""

from mjx_refine.search.options import OPTIMIZERS, Options
from mjx_refine.search.progress import Progress, Step
from mjx_refine.search.refine import refine
from mjx_refine.search.result import ParameterRow, RefineResult, Replay

__all__ = ["OPTIMIZERS", "Options", "ParameterRow", "Progress", "RefineResult", "Replay", "Step", "refine"]
