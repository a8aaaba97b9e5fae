"""From poses and camera to what the ray caster needs for each candidate, frame and object."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Frames:
    """Ray-casting coefficients of F frames with N objects.

    A pixel's ray in camera coordinates is (u, v, -1), x right, y up, looking along -z.

    Attributes:
      ray: rotates that ray into the object's frame.
      origin: the camera's centre in the object's frame [m].
      size: MuJoCo's ``geom_size`` [m].
      next_matrix: takes a point of the object's frame to camera coordinates of the next frame.
      next_offset: ditto, the translation [m].
      down: z component of the world ray is ``down . (u, v, -1)``.
      height: the camera's height above the floor [m].
      focal: focal length [px].
    """

    ray: Float[Array, "frames objects 3 3"]
    origin: Float[Array, "frames objects 3"]
    size: Float[Array, "frames objects 3"]
    next_matrix: Float[Array, "frames objects 3 3"]
    next_offset: Float[Array, "frames objects 3"]
    down: Float[Array, "frames 3"]
    height: Float[Array, "frames"]
    focal: Float[Array, "frames"]


def rotation_matrix(quaternion: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrices of unit quaternions w x y z."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def camera_matrix(pitch: Float[Array, "*batch"]) -> Float[Array, "*batch 3 3"]:
    """Camera to world: a rotation about the world's x axis by ``pitch`` [rad]; 0 looks straight down."""
    c, s, one, zero = jnp.cos(pitch), jnp.sin(pitch), jnp.ones_like(pitch), jnp.zeros_like(pitch)
    rows = [[one, zero, zero], [zero, c, -s], [zero, s, c]]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def make_frames(
    poses: Float[Array, "batch frames objects 7"],
    size: Float[Array, "batch objects 3"],
    camera_position: Float[Array, "batch 3"],
    camera_pitch: Float[Array, "batch"],
    camera_fovy: Float[Array, "batch"],
    height_px: int,
) -> Frames:
    """Coefficients of every frame of every candidate, flattened to batch * frames.

    The last frame has no next one; its flow is zero. ``height_px`` is the image's full height, which ``focal`` is for.
    """
    batch, count, objects = poses.shape[:3]
    to_world = rotation_matrix(poses[..., 3:])
    following = jnp.concatenate([poses[:, 1:], poses[:, -1:]], axis=1)
    camera = camera_matrix(camera_pitch)[:, None, None]
    centre = camera_position[:, None, None]

    # Products of 3x3 matrices, written out: a batched matrix product of this size is slow on every device.
    def times(a: Array, b: Array, transpose_a: bool) -> Array:
        a = jnp.swapaxes(a, -1, -2) if transpose_a else a
        return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)

    def apply_transposed(a: Array, x: Array) -> Array:
        return (a * x[..., :, None]).sum(-2)

    camera_full = jnp.broadcast_to(camera, to_world.shape)
    focal = (height_px / 2) / jnp.tan(camera_fovy / 2)

    def flat(x: Array) -> Array:
        return x.reshape(batch * count, *x.shape[2:])

    def each_frame(x: Array) -> Array:
        return flat(jnp.broadcast_to(x[:, None], (batch, count, *x.shape[1:])))

    return Frames(
        ray=flat(times(to_world, camera_full, True)),
        origin=flat(apply_transposed(to_world, centre - poses[..., :3])),
        size=flat(jnp.broadcast_to(size[:, None], (batch, count, objects, 3))),
        next_matrix=flat(times(camera_full, rotation_matrix(following[..., 3:]), True)),
        next_offset=flat(apply_transposed(camera_full, following[..., :3] - centre)),
        down=each_frame(camera_matrix(camera_pitch)[:, 2, :]),
        height=each_frame(camera_position[:, 2]),
        focal=each_frame(focal),
    )


def frames_of_batch(
    poses: Float[Array | np.ndarray, "batch frames objects 7"], batch: SceneBatch, height_px: int
) -> Frames:
    """``make_frames`` with the camera and sizes of ``batch``, in float32."""
    arrays = (poses, batch.size, batch.camera_position, batch.camera_pitch, batch.camera_fovy)
    return compiled_frames(*(a if isinstance(a, jax.Array) else np.asarray(a, np.float32) for a in arrays), height_px)


compiled_frames = jax.jit(make_frames, static_argnums=5)
