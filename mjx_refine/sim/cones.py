"""The kernel that adds the curvature of friction cones to the solver's Hessian, for free bodies only.

MJX-Warp's own looks at every pair of degrees of freedom of the scene for every contact. A contact touches two bodies, which
have twelve: of four objects that is 78 pairs instead of 300. There the kernel took 0.89 of 3.0 ms of a step with 3,072
candidates on an H100, and ours, as first written, 0.36 with 2,688; with two
objects, which have 78 pairs anyway, nothing is gained.
"""

# pyright: reportInvalidTypeForm=false

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator

import warp as wp

from mjx_refine.sim.mjx_import import warp_engine

_solver = importlib.import_module(f"{warp_engine().__name__}._src.solver")
_types = importlib.import_module(f"{warp_engine().__name__}._src.types")

_CONE = wp.constant(int(_types.ConstraintState.CONE))
_PAIRS = wp.constant(78)
"""Entries of the upper triangle of twelve degrees of freedom."""

_LEAST = wp.constant(1.0e-15)
"""MuJoCo's ``mjMINVAL``."""


@wp.func
def _involved(jacobian: wp.array3d(dtype=float), world: int, row: int, body: int) -> bool:
    """Whether a contact's normal moves the body: a unit vector has some component."""
    first = 6 * body
    return (
        jacobian[world, row, first] != 0.0
        or jacobian[world, row, first + 1] != 0.0
        or jacobian[world, row, first + 2] != 0.0
    )


@wp.func
def _bodies(jacobian: wp.array3d(dtype=float), world: int, row: int, count: int) -> wp.vec2i:
    """The one or two bodies that a contact moves; -1: none."""
    first = int(-1)
    second = int(-1)
    for body in range(count):  # a warp's threads read the same few numbers
        if _involved(jacobian, world, row, body):
            if first < 0:
                first = body
            else:
                second = body
    return wp.vec2i(first, second)


@wp.func
def _column(bodies: wp.vec2i, k: int) -> int:
    """The k-th of the bodies' twelve degrees of freedom; -1 where there is no second body."""
    body = bodies[0]  # pyright: ignore[reportIndexIssue]
    if k >= 6:
        body = bodies[1]  # pyright: ignore[reportIndexIssue]
    return wp.where(body < 0, -1, 6 * body + k % 6)


@wp.func
def _row_of_pair(pair: int) -> int:
    """j of the pair (i, j), i <= j, whose number is j (j + 1) / 2 + i; rounding of the root does not matter."""
    j = int((wp.sqrt(8.0 * float(pair) + 1.0) - 1.0) * 0.5)
    if (j + 1) * (j + 2) // 2 <= pair:
        j += 1
    if j * (j + 1) // 2 > pair:
        j -= 1
    return j


@wp.func
def _entry(
    jacobian: wp.array3d(dtype=float),
    residual: wp.array2d(dtype=float),
    address: wp.array2d(dtype=int),
    scale: _types.vec5,
    mu: float,
    world: int,
    contact: int,
    rows: int,
    line: int,
    column: int,
) -> float:
    """Of the cone's curvature, over its stiffness (``solver._elliptic_hessian_entry_from_projections``)."""
    row = address[contact, 0]
    a0 = mu * jacobian[world, row, line]
    b0 = mu * jacobian[world, row, column]
    slip = float(0.0)
    along_a = float(0.0)
    along_b = float(0.0)
    across = float(0.0)
    for k in range(1, rows):
        at = address[contact, k]
        if at >= 0:
            u = residual[world, at] * scale[k - 1]
            a = scale[k - 1] * jacobian[world, at, line]
            b = scale[k - 1] * jacobian[world, at, column]
            slip += u * u
            along_a += u * a
            along_b += u * b
            across += a * b
    length = wp.max(wp.sqrt(slip), _LEAST)
    along_a /= length
    along_b /= length
    pull = mu * residual[world, row] * mu / length
    return a0 * b0 - mu * (a0 * along_b + b0 * along_a) + pull * along_a * along_b + (mu * mu - pull) * across


@wp.kernel
def cone_curvature(
    impratio_invsqrt: wp.array(dtype=float),
    tri_row: wp.array(dtype=int),
    tri_col: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    margin: wp.array(dtype=float),
    friction: wp.array(dtype=_types.vec5),
    dimension: wp.array(dtype=int),
    address: wp.array2d(dtype=int),
    world_of: wp.array(dtype=int),
    jacobian: wp.array3d(dtype=float),
    weight: wp.array2d(dtype=float),
    state: wp.array2d(dtype=int),
    most: int,
    count: wp.array(dtype=int),
    residual: wp.array2d(dtype=float),
    done: wp.array(dtype=bool),
    repeats: int,
    blocks: int,
    hessian: wp.array3d(dtype=float),
):
    """Arguments as of ``solver._update_gradient_JTCJ_dense``; threads take contacts' pairs in turns."""
    block, element = wp.tid()  # pyright: ignore
    width = tri_row.shape[0]
    bodies = (tri_row[width - 1] + 1) // 6
    for item in range(block * width + element, wp.min(count[0], most) * _PAIRS, blocks * width):
        # What depends on nothing is read first.
        contact = item // _PAIRS
        world = world_of[contact]
        rows = dimension[contact]
        row = address[contact, 0]
        scale = friction[contact]
        apart = distance[contact] - margin[contact]
        if rows == 1 or apart >= 0.0 or row < 0:
            continue
        shape = state[world, row]
        stiff = weight[world, row]
        mu = scale[0] * impratio_invsqrt[world % impratio_invsqrt.shape[0]]
        both = _bodies(jacobian, world, row, bodies)
        if done[world] or shape != _CONE or stiff == 0.0:
            continue
        pair = item - contact * _PAIRS
        j = _row_of_pair(pair)
        line = _column(both, pair - j * (j + 1) // 2)
        column = _column(both, j)
        if line < 0 or column < 0:
            continue
        entry = _entry(jacobian, residual, address, scale, mu, world, contact, rows, line, column)
        stiff /= wp.max(mu * mu * (1.0 + mu * mu), _LEAST)
        wp.atomic_add(hessian, world, line, column, stiff * entry)


@contextlib.contextmanager
def fast_cones() -> Iterator[None]:
    """While it lasts, steps are made with ``cone_curvature`` where the solver has the kernel that it stands for."""
    own = getattr(_solver, "_update_gradient_JTCJ_dense", None)
    if own is None or len(own.adj.args) != len(cone_curvature.adj.args):
        yield
        return
    _solver._update_gradient_JTCJ_dense = cone_curvature
    try:
        yield
    finally:
        _solver._update_gradient_JTCJ_dense = own
