"""Whether MJX-Warp can run here, told without importing MJX or Warp, which takes seconds."""

from __future__ import annotations

import importlib.util

import jax

REMEDY = "pip install 'mjx-refine[warp]' on a machine with an NVIDIA GPU, or choose --backend mujoco"


def warp_problem() -> str | None:
    """Why MJX-Warp cannot run here, or None where it can."""
    if importlib.util.find_spec("warp") is None:
        return "the package warp-lang is not installed"
    try:
        found = jax.devices("cuda")
    except RuntimeError:
        found = []
    return None if found else "JAX sees no NVIDIA GPU"
