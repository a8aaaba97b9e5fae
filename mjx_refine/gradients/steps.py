"""Steps of MJX with derivatives that are right: implicit ones of its solver, and of turning from rest.

The solver's acceleration a minimises a convex cost, so g(a, p) = 0 with g its gradient and p everything else. Hence
da/dp = -H^-1 dg/dp with the Hessian H = dg/da (Krantz and Parks, The Implicit Function Theorem, theorem 3.3.1; for
solvers: Blondel et al. 2022, Efficient and Modular Implicit Differentiation, equation 2). The iterations are not
differentiated at all: they may stop early, single precision does as well as double, and reverse mode works, which
refuses a ``while_loop``.

MJX turns a quaternion by an axis and an angle, the norm of the angular velocity, whose derivative it takes for zero at
zero: an object that does not spin would not begin to, whatever its tangent says. Here the turn is smooth in the velocity.
"""

from __future__ import annotations

import contextlib
import importlib
import threading
from collections.abc import Iterator

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from mjx_refine.errors import InputError
from mjx_refine.sim.mjx_import import mjx

_solver = importlib.import_module(f"{mjx.__name__}._src.solver")
_math = importlib.import_module(f"{mjx.__name__}._src.math")
_support = importlib.import_module(f"{mjx.__name__}._src.support")
_lock = threading.RLock()
NEEDED = ("qacc", "Ma", "qfrc_constraint", "active", "h")
"""Fields of the solver's context that are used here."""


def _hessian(model, data, context) -> Float[Array, "nv nv"]:
    """Second derivative of the solver's cost in the acceleration."""
    diagonal = jnp.diag(data._impl.efc_D * context.active)
    contact = data._impl.contact
    several = contact.dim > 1
    # The rows of a sliding contact are coupled by its cone.
    for i, (size, row) in enumerate(zip(contact.dim[several], contact.efc_address[several], strict=True)):
        diagonal = diagonal.at[row : row + size, row : row + size].add(context.h[i, :size, :size])
    jacobian = data._impl.efc_J
    full = _support.full_m(model, data) + jacobian.T @ diagonal @ jacobian
    return 0.5 * (full + full.T)


def _moving(value: Float[Array, "nv"], like: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """``value`` with the derivatives of ``like``."""
    return stop_gradient(value) + (like - stop_gradient(like))


def _differentiable(original):
    def solve(model, data):
        still_model, still_data = stop_gradient((model, data))
        solved = stop_gradient(original(still_model, still_data))
        at = data.replace(qacc=solved.qacc)
        context = _solver.Context.create(model, at, grad=False)
        slope = context.Ma - data.qfrc_smooth - context.qfrc_constraint
        still = _solver.Context.create(still_model, still_data.replace(qacc=solved.qacc), grad=False)
        factor = jax.scipy.linalg.cho_factor(stop_gradient(_hessian(still_model, still_data, still)))
        qacc = _moving(solved.qacc, -jax.scipy.linalg.cho_solve(factor, slope))
        # At the minimum the constraint's force is what the smooth forces leave open.
        force = _support.mul_m(model, data, qacc) - data.qfrc_smooth
        return data.replace(qacc=qacc, qfrc_constraint=_moving(solved.qfrc_constraint, force))

    return solve


SMALL = 1e-6
"""Square of half the angle of a turn [rad^2] below which its sine and cosine are their series."""


def quat_integrate(q: Float[Array, "4"], v: Float[Array, "3"], dt: Float[Array, ""]) -> Float[Array, "4"]:
    """``q`` turned for the time ``dt`` [s] with angular velocity ``v`` [rad/s] of the body's frame; smooth at zero."""
    half = 0.5 * dt * v
    square = half @ half
    small = square < SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    cosine = jnp.where(small, 1.0 - square / 2.0, jnp.cos(angle))
    sinc = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    turned = _math.quat_mul(q, jnp.concatenate([cosine[None], sinc * half]))
    return turned / jnp.sqrt(turned @ turned)


@contextlib.contextmanager
def differentiable_steps() -> Iterator[None]:
    """While it lasts, steps of MJX that are traced have these derivatives, in both modes; values are the same.

    Raises:
      InputError: the installed mujoco-mjx has another solver, or another turn, than this was written for.
    """
    original = getattr(_solver, "solve", None)
    fields = getattr(getattr(_solver, "Context", None), "__dataclass_fields__", {})
    known = callable(original) and set(NEEDED) <= set(fields) and hasattr(_math, "quat_integrate")
    if not known:
        raise InputError(
            "mujoco-mjx: its solver (solver.solve, solver.Context) or math.quat_integrate is not as in 3.17.0, and "
            "derivatives hook into them; "
            "pip install mujoco==3.17.0 mujoco-mjx==3.17.0, or search without derivatives"
        )
    with _lock:
        original, turn = _solver.solve, _math.quat_integrate
        _solver.solve, _math.quat_integrate = _differentiable(original), quat_integrate
        try:
            yield
        finally:
            _solver.solve, _math.quat_integrate = original, turn
