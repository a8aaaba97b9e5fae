"""Compilers' caches on disk, and a line on stderr for every compilation, since each takes from seconds to minutes."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import jax

log = logging.getLogger("mjx_refine")

VARIABLE = "MJX_REFINE_CACHE"
"""Environment variable that names the cache folder; ``off`` turns the caches off."""

QUICK: dict[str, bool | int] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_llvm_disable_expensive_passes": True,
    "xla_backend_optimization_level": 1,
}
"""How XLA compiles ``jit_quickly``'s programs on a CPU."""

_KERNELS: dict[str, str] = {}


def cache_folder() -> Path | None:
    """The folder of the caches: what MJX_REFINE_CACHE says, else the user's cache folder; None where it is off."""
    chosen = os.environ.get(VARIABLE)
    if chosen and chosen.lower() in ("0", "off", "none"):
        return None
    if chosen:
        return Path(chosen).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mjx-refine"


def enable_cache() -> Path | None:
    """Makes JAX, and Warp where it is installed, keep compiled programs on disk.

    A cache is a convenience: where its folder cannot be written, a warning is logged and compilation goes on without.

    Returns:
      the folder, or None where there is no cache.
    """
    folder = cache_folder()
    if folder is None:
        return None
    try:
        (folder / "jax").mkdir(parents=True, exist_ok=True)
        (folder / "kernels").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        log.warning("%s: no compilation cache (%s); set %s to another folder", folder, error.strerror, VARIABLE)
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    _KERNELS.setdefault("folder", str(folder / "kernels"))
    if "warp" in sys.modules:
        keep_kernels(sys.modules["warp"])
    return folder


def keep_kernels(warp: ModuleType) -> None:
    """Makes Warp, just imported, keep its kernels where ``enable_cache`` said: it is imported by those alone who need it, since
    that takes seconds.

    Once only, and before its first kernel: Warp then adds its version to the folder, and what is written beside that counts as
    another version's, of which it warns. A folder that the caller chose stays.
    """
    if "folder" in _KERNELS and warp.config.kernel_cache_dir is None:
        warp.config.kernel_cache_dir = _KERNELS["folder"]


@contextlib.contextmanager
def compiling(what: str) -> Iterator[None]:
    """Logs that ``what`` is being compiled, and how long it took [s]."""
    log.info("compiling %s ...", what)
    start = time.perf_counter()
    yield
    log.info("compiled %s in %.1f s", what, time.perf_counter() - start)


def jit_quickly(function: Callable, static_argnums: int | tuple[int, ...] = ()) -> Callable:
    """``jax.jit`` of a program of many small operations that is called by itself, not inside another.

    On a CPU, XLA's fusion emitters and LLVM's dear passes take most of the seconds that such a program needs to be compiled, and
    it runs no faster for them: outlines and flow of a box and a cylinder compile in a fifth of the time, and run in half of it.
    Last bits of a row may then depend on how many rows there are.
    """
    plain = jax.jit(function, static_argnums=static_argnums)
    quick = jax.jit(function, static_argnums=static_argnums, compiler_options=QUICK)

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        return (quick if _on_a_cpu() and _knows_quick() else plain)(*arguments)

    return call


def _on_a_cpu() -> bool:
    device = jax.config.jax_default_device
    if device is None:
        return jax.default_backend() == "cpu"
    return (device if isinstance(device, str) else device.platform) == "cpu"


@functools.cache
def _knows_quick() -> bool:
    """Whether this version of XLA has all of ``QUICK``; they are not what JAX promises to keep."""
    try:
        jax.jit(lambda x: x, compiler_options=QUICK).lower(0.0).compile()
    except Exception as error:  # jaxlib's own kind, which is not public
        log.debug("programs are compiled as XLA does by default (%s)", error)
        return False
    return True
