"""How our colliders get into MJX: its private table of collision functions, guarded."""

from __future__ import annotations

import contextlib
import importlib
import threading
from collections.abc import Iterator

import jax
import jax.numpy as jnp

from mjx_refine.errors import InputError
from mjx_refine.sim.colliders.contact import GeomType
from mjx_refine.sim.colliders.table import COLLIDERS
from mjx_refine.sim.mjx_import import mjx

collision_driver = importlib.import_module(f"{mjx.__name__}._src.collision_driver")
solver = importlib.import_module(f"{mjx.__name__}._src.solver")

_lock = threading.RLock()


def _table() -> dict:
    """MJX's table of collision functions.

    Raises:
      InputError: the installed mujoco-mjx has no such table, or one of another form.
    """
    table = getattr(collision_driver, "_COLLISION_FUNC", None)
    pair = (GeomType.PLANE, GeomType.SPHERE)
    if not isinstance(table, dict) or not isinstance(getattr(table.get(pair), "ncon", None), int):
        raise InputError(
            "mujoco-mjx: its table of collision functions (collision_driver._COLLISION_FUNC) is not as in 3.17.0, and "
            "box-cylinder contacts hook into it; pip install mujoco==3.17.0 mujoco-mjx==3.17.0, "
            "or choose --backend mujoco"
        )
    return table


class _SafeNumpy:
    """``jax.numpy`` whose square root has derivative zero at zero.

    MJX's line search takes the root of the slip of every possible contact, which is exactly zero where there is none:
    the infinite derivative times zero makes every forward-mode derivative NaN.
    """

    def __getattr__(self, name: str):
        return getattr(jnp, name)

    @staticmethod
    def sqrt(x: jax.Array) -> jax.Array:
        zero = x == 0
        return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, x)))


@contextlib.contextmanager
def installed() -> Iterator[None]:
    """While it lasts, MJX finds our colliders, and its solver has forward-mode derivatives without NaN.

    Wrap what builds models and data, and what traces a step.
    """
    with _lock:
        table = _table()
        before = dict(table)
        table.update(COLLIDERS)
        numpy = solver.jp
        solver.jp = _SafeNumpy()
        try:
            yield
        finally:
            solver.jp = numpy
            table.clear()
            table.update(before)
