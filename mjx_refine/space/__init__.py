"""The named, bounded parameter space between scenes and the unit box."""

from mjx_refine.space.parameter import Parameter
from mjx_refine.space.space import Space, decode_together

__all__ = ["Parameter", "Space", "decode_together"]
