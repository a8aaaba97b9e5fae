"""Colliders of ours for MJX-JAX, where its own lack a pairing or differ from C MuJoCo's."""

from mjx_refine.sim.colliders.hook import installed

__all__ = ["installed"]
