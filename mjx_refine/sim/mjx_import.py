"""Imports MJX without what it and Warp print on standard output, where a command's results belong."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
from types import ModuleType

from mjx_refine.compile_cache import keep_kernels

if importlib.util.find_spec("warp") is not None:
    warp = importlib.import_module("warp")
    warp.config.log_level = warp.LOG_WARNING
    keep_kernels(warp)

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

__all__ = ["mjx", "warp_engine"]


def warp_engine() -> ModuleType:
    """The engine that MJX drives through Warp, itself; it cannot be imported where Warp is not installed."""
    with contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco.mjx.third_party.mujoco_warp")
