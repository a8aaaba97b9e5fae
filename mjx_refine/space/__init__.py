"""The named, bounded parameter space between scenes and the unit box."""

from mjx_refine.space.parameter import Parameter
from mjx_refine.space.space import Space

__all__ = ["Parameter", "Space"]
