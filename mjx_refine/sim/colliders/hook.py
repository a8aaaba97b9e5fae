"""How our colliders get into MJX: its private table of collision functions, guarded."""

from __future__ import annotations

import contextlib
import importlib
import threading
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_refine.errors import InputError
from mjx_refine.sim.mjx_import import mjx

Geom = tuple[Float[Array, "3"], Float[Array, "3 3"], Float[Array, "3"]]
"""Position [m], rotation (columns are the geom's axes in the world) and ``geom_size`` [m]."""

Points = tuple[Float[Array, " points"], Float[Array, "points 3"], Float[Array, "points 3"]]
"""Distance (positive: no contact), position and normal from the first geom to the second, of every contact point."""

collision_driver = importlib.import_module(f"{mjx.__name__}._src.collision_driver")
solver = importlib.import_module(f"{mjx.__name__}._src.solver")
GeomType = mjx.GeomType

_lock = threading.RLock()


def frames_of(normal: Float[Array, "points 3"]) -> Float[Array, "points 3 3"]:
    """Contact frames: rows are the normal and two tangents, chosen as C MuJoCo's ``mju_makeFrame`` does."""
    upright = (jnp.abs(normal[:, 1]) < 0.5)[:, None]
    other = jnp.where(upright, jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    first = other - (other * normal).sum(-1, keepdims=True) * normal
    first = first / jnp.linalg.norm(first, axis=-1, keepdims=True)
    return jnp.stack([normal, first, jnp.cross(normal, first)], 1)


def as_mjx(function: Callable[[Geom, Geom], Points], points: int) -> Callable:
    """``function`` of two geoms in the form that MJX's collision driver calls."""

    def collide(model, data, _key, geom):
        def one(first, second):
            sides = ((data.geom_xpos[g], data.geom_xmat[g], model.geom_size[g]) for g in (first, second))
            distance, position, normal = function(*sides)
            return distance, position, frames_of(normal)

        found = jax.vmap(one)(geom[:, 0], geom[:, 1])
        return jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:]), found)

    collide.ncon = points
    return collide


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
    from mjx_refine.sim.colliders.table import COLLIDERS

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
