"""Outlines and flow of a whole batch in one program, for a device to which a call costs more than what it computes."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.scene import Shape
from mjx_refine.view.outline import padded, support_function
from mjx_refine.view.points import point_flow_function

ROWS = (8, 64, 128, 256, 512)
"""Batch sizes that are compiled; larger batches are multiples of the last."""


def reach_and_flow(
    poses: Float[np.ndarray, "batch frames objects 7"],
    batch: SceneBatch,
    pixels: Float[np.ndarray, "frames objects points 2"],
    image: tuple[int, int],
    count: int,
) -> tuple[Float[np.ndarray, "batch frames objects directions"], Float[np.ndarray, "batch frames objects points 2"]]:
    """``supports`` in ``count`` directions [px] and ``point_flow`` at ``pixels`` [px/frame]; without effects.

    There and back once: on a GPU's machine calls and transfers are what takes time.
    """
    shown, *camera = padded(poses, batch, ROWS)
    seen_from = np.concatenate([np.reshape(a, (len(a), -1)) for a in camera], 1)
    told = np.asarray(_reach_and_flow(batch.shapes, image, count, shown, seen_from, np.asarray(pixels, np.float32)))
    told = told[: len(poses)]
    return told[..., :count], told[..., count:].reshape(*told.shape[:3], -1, 2)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _reach_and_flow(
    shapes: tuple[Shape, ...],
    image: tuple[int, int],
    count: int,
    poses: Float[Array, "batch frames objects 7"],
    seen_from: Float[Array, "batch values"],
    pixels: Float[Array, "frames objects points 2"],
) -> Float[Array, "batch frames objects values"]:
    """``seen_from``: sizes, the camera's place, pitch, field of view."""
    rows, sizes = len(poses), 3 * len(shapes)
    size, position, pitch, fovy = jnp.split(seen_from, (sizes, sizes + 3, sizes + 4), 1)
    arrays = poses, size.reshape(rows, len(shapes), 3), position, pitch[:, 0], fovy[:, 0]
    flow = point_flow_function(shapes, arrays, pixels, image)
    return jnp.concatenate(
        [support_function(shapes, arrays, count, image), flow.reshape(*poses.shape[:3], 2 * pixels.shape[2])], -1
    )
