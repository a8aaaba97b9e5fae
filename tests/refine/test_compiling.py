"""Programs that are compiled in a hurry say what the others say."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_refine import compile_cache
from mjx_refine.compile_cache import jit_quickly
from mjx_refine.view.outline import support_function


def arrays():
    generator = np.random.default_rng(3)
    poses = np.tile([0.0, 2.0, 0.5, 1.0, 0.0, 0.0, 0.0], (8, 6, 2, 1)) + 0.2 * generator.standard_normal((8, 6, 2, 7))
    return tuple(
        jnp.asarray(a, jnp.float32)
        for a in (poses, np.full((8, 2, 3), 0.3), np.tile([0.0, -2.0, 4.0], (8, 1)), np.ones(8), np.ones(8))
    )


def test_they_agree_to_rounding():
    ordinary = jax.jit(support_function, static_argnums=(0, 2, 3))
    quick = jit_quickly(support_function, static_argnums=(0, 2, 3))
    for count in (4, 16):
        call = (("box", "cylinder"), arrays(), count, (480, 320))
        np.testing.assert_allclose(quick(*call), ordinary(*call), rtol=2e-5, atol=2e-3)


def test_they_are_told_how_to_compile_on_a_cpu_alone(monkeypatch):
    used = []

    def jit(function, static_argnums=(), compiler_options=None):
        return lambda *arguments: used.append(compiler_options)

    monkeypatch.setattr(compile_cache, "_knows_quick", lambda: True)
    with monkeypatch.context() as patch:
        patch.setattr(jax, "jit", jit)
        call = jit_quickly(lambda x: x)
    call(1.0)
    with jax.default_device(jax.devices("cpu")[0]):
        call(1.0)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    call(1.0)
    with jax.default_device(jax.devices("cpu")[0]):
        call(1.0)
    assert used == [compile_cache.QUICK, compile_cache.QUICK, None, compile_cache.QUICK]


@pytest.mark.parametrize(("options", "known"), [(None, True), ({"xla_no_such_option": True}, False)])
def test_a_compiler_that_does_not_know_the_options_compiles_as_ever(monkeypatch, options, known):
    if options is not None:
        monkeypatch.setattr(compile_cache, "QUICK", options)
    compile_cache._knows_quick.cache_clear()
    try:
        assert compile_cache._knows_quick() == known
        assert float(jit_quickly(lambda x: 2 * x)(jnp.float32(3.0))) == 6.0
    finally:
        compile_cache._knows_quick.cache_clear()
