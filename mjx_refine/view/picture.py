"""Whole pictures: masks and flow of every frame, for output, reports and tests."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mjx_refine.batch import SceneBatch
from mjx_refine.scene import Shape
from mjx_refine.view.frames import Frames, frames_of_batch
from mjx_refine.view.rays import cast


@functools.partial(jax.jit, static_argnames=("shapes", "width", "height"))
def _draw(shapes: tuple[Shape, ...], frames: Frames, width: int, height: int):
    y, x = jnp.meshgrid(jnp.arange(height) + 0.5, jnp.arange(width) + 0.5, indexing="ij")
    x, y = x.reshape(1, -1).astype(jnp.float32), y.reshape(1, -1).astype(jnp.float32)

    def one(frame: Frames):
        frame = jax.tree.map(lambda a: a[None], frame)
        return cast(shapes, frame, x, y, (width / 2, height / 2))

    return jax.lax.map(one, frames)


def draw(
    poses: Float[np.ndarray, "frames objects 7"], batch: SceneBatch, size: tuple[int, int], row: int = 0
) -> tuple[Int[np.ndarray, "frames height width"], Float[np.ndarray, "intervals height width 2"]]:
    """Masks (0 background, k + 1 for object k) and flow [px/frame] of one candidate.

    Args:
      poses: of candidate ``row``: positions [m] and quaternions wxyz.
      batch: its sizes and camera.
      size: (width, height) [px].
      row: which candidate of ``batch``.
    """
    width, height = size
    frames = frames_of_batch(jnp.asarray(poses)[None], batch[row : row + 1], height)
    ids, flow_x, flow_y = (np.asarray(a) for a in _draw(batch.shapes, frames, width, height))
    masks = ids.reshape(-1, height, width)
    flow = np.stack([flow_x, flow_y], -1).reshape(-1, height, width, 2)[:-1]
    return masks, flow
