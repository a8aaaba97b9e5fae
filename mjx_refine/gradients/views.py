"""Views of one rollout as functions for ``Differentiator.jacobian``, and one in double precision for differences."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.scene import Shape
from mjx_refine.view.outline import support_function
from mjx_refine.view.points import point_flow_function

BLOCK = 32
"""Candidates whose outlines are computed at a time; one program serves every number of them."""


def poses_view(poses, size, camera_position, camera_pitch, camera_fovy) -> Float[Array, "frames objects 7"]:
    """The poses themselves."""
    return poses


@functools.cache
def outline_view(shapes: tuple[Shape, ...], image: tuple[int, int], directions: int) -> Callable[..., Array]:
    """A view of how far each silhouette reaches [px], (T, N, directions); the same object for the same arguments."""

    def view(*arrays):
        return support_function(shapes, tuple(a[None] for a in arrays), directions, image)[0]

    return view


@functools.cache
def flow_view(shapes: tuple[Shape, ...], image: tuple[int, int]) -> Callable[..., Array]:
    """A view of the flow [px/frame] at pixels (its first ``data``), (T, N, points, 2)."""

    def view(*arrays):
        *state, pixels = arrays
        return point_flow_function(shapes, tuple(a[None] for a in state), pixels, image)[0]

    return view


def precise_outlines(
    shapes: tuple[Shape, ...], arrays: tuple[np.ndarray, ...], image: tuple[int, int], directions: int
) -> Float[np.ndarray, "batch frames objects directions"]:
    """``view.supports`` in double precision, which differences of small steps need.

    ``arrays`` are poses, sizes and the camera's position, pitch and field of view, each with a leading batch axis.
    """
    count = len(arrays[0])
    rows = np.minimum(np.arange(-(-count // BLOCK) * BLOCK), count - 1)
    result = []
    with jax.enable_x64(True):
        for first in range(0, len(rows), BLOCK):
            chosen = rows[first : first + BLOCK]
            part = tuple(jnp.asarray(a[chosen], jnp.float64) for a in arrays)
            result.append(np.asarray(_outlines(shapes, part, directions, image)))
    return np.concatenate(result)[:count]


_outlines = jax.jit(support_function, static_argnums=(0, 2, 3))
