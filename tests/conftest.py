"""Hypothesis and JAX as every test wants them."""

from __future__ import annotations

from hypothesis import settings

from mjx_refine.compile_cache import enable_cache

# The same examples in every run, and no time limit on one: the first call of a kernel compiles it.
settings.register_profile("tests", deadline=None, derandomize=True, max_examples=50, database=None)
settings.load_profile("tests")

# Compiled programs are kept between runs.
enable_cache()
