"""Outlines of bodies as support functions of their silhouettes: exact, smooth in the pose, without drawing a pixel."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_refine.batch import SceneBatch
from mjx_refine.scene import Shape
from mjx_refine.view.frames import camera_matrix, rotation_matrix

RIM = 32
"""Points on a circle; its polygon falls short of it by at most 0.5 % of the radius."""

BATCHES = (8, 32, 128)
"""Batch sizes that are compiled; larger batches are multiples of the last."""

NEAR = 0.02
"""Depth [m] to which points behind the camera are moved."""


def directions(count: int) -> Float[np.ndarray, "directions 2"]:
    """Unit vectors in the image, evenly spaced, the first to the right."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def _circle() -> Array:
    angle = 2 * jnp.pi * jnp.arange(RIM) / RIM
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)


def _sphere(position: Array, size: Array, camera: Array) -> Array:
    """The circle in which the view cone touches the sphere."""
    to_centre = position - camera
    distance = jnp.maximum(jnp.linalg.norm(to_centre, axis=-1, keepdims=True), 1e-6)
    axis = to_centre / distance
    ratio = jnp.minimum(size[..., :1] / distance, 0.999)
    helper = jnp.where(jnp.abs(axis[..., 2:]) < 0.9, jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0]))
    e1 = jnp.cross(axis, helper)
    e1 = e1 / jnp.linalg.norm(e1, axis=-1, keepdims=True)
    e2 = jnp.cross(axis, e1)
    middle = position - axis * (size[..., :1] * ratio)
    radius = size[..., :1] * jnp.sqrt(1 - ratio * ratio)
    circle = _circle()
    return middle[..., None, :] + radius[..., None] * (
        circle[:, :1] * e1[..., None, :] + circle[:, 1:] * e2[..., None, :]
    )


def _local_points(shape: Shape, size: Array) -> Array:
    """Extreme points in the body's frame, (..., points, 3)."""
    if shape == "box":
        signs = jnp.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], jnp.float32)
        return size[..., None, :] * signs
    circle = _circle()
    rim = jnp.concatenate([circle, jnp.zeros((RIM, 1))], -1)
    cap = jnp.array([0.0, 0.0, 1.0])
    radius, half = size[..., None, :1], size[..., None, 1:2]
    return jnp.concatenate([radius * rim + half * cap, radius * rim - half * cap], -2)


@functools.partial(jax.jit, static_argnames=("shapes", "count", "width", "height"))
def _supports(shapes, poses, size, camera_position, camera_pitch, camera_fovy, count, width, height):
    camera = camera_matrix(camera_pitch)[:, None, None]
    focal = ((height / 2) / jnp.tan(camera_fovy / 2))[:, None, None]
    normals = jnp.asarray(directions(count), jnp.float32)
    result = []
    for n, shape in enumerate(shapes):
        pose, extent = poses[:, :, n], size[:, None, n]
        if shape == "sphere":
            points = _sphere(pose[..., :3], jnp.broadcast_to(extent, pose[..., :3].shape), camera_position[:, None])
        else:
            local = _local_points(shape, extent)
            turned = (rotation_matrix(pose[..., 3:])[..., None, :, :] * local[..., None, :]).sum(-1)
            points = turned + pose[..., None, :3]
        relative = points - camera_position[:, None, None]
        x, y, z = ((camera[..., :, i] * relative).sum(-1) for i in range(3))
        depth = jnp.maximum(-z, NEAR)
        px, py = focal * x / depth + width / 2, -focal * y / depth + height / 2
        along = px[..., None] * normals[:, 0] + py[..., None] * normals[:, 1]
        result.append(along.max(-2))
    return jnp.stack(result, 2)


def supports(
    poses: Float[np.ndarray, "batch frames objects 7"], batch: SceneBatch, image: tuple[int, int], count: int
) -> Float[np.ndarray, "batch frames objects directions"]:
    """How far each silhouette reaches in each of ``count`` directions of the image [px].

    The support function of a convex outline, h(n) = max over its points p of n . p (Schneider, Convex Bodies, 1.7).
    Occlusion and the image's border do not matter to it.
    """
    arrays = (poses, batch.size, batch.camera_position, batch.camera_pitch, batch.camera_fovy)
    # Few sizes are ever compiled: a search asks for batches of many lengths.
    size = next((b for b in BATCHES if b >= len(poses)), -(-len(poses) // BATCHES[-1]) * BATCHES[-1])
    padded = [np.concatenate([a, np.repeat(a[:1], size - len(a), 0)]) for a in map(np.asarray, arrays)]
    device = [jnp.asarray(a, jnp.float32) for a in padded]
    return np.asarray(_supports(batch.shapes, *device, count, *image))[: len(poses)]
