"""Poses between frames, and where pixels of a bent picture lie in the straight one."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from mjx_refine import rotations
from mjx_refine.batch import SceneBatch
from mjx_refine.effects import acting


def poses_at(
    poses: Float[np.ndarray, "batch frames objects 7"], times: Float[np.ndarray, "batch moments"]
) -> Float[np.ndarray, "batch moments objects 7"]:
    """Poses at ``times`` [frames]: cubic in position, steady turns between frames, steady motion beyond the clip.

    Exact where the motion between frames is a parabola with a steady spin. At an impact inside of a frame, where the
    velocity jumps by dv, positions are off by up to dv / (4 fps), at the moment of the impact.
    """
    position, quaternion = poses[..., :3], poses[..., 3:]
    if poses.shape[1] == 1:
        return np.repeat(poses, times.shape[1], 1)
    ends = []
    for a, b, c in ((0, 1, 2), (-1, -2, -3)):
        near, next_, far = (position[:, k] for k in (a, b, c if poses.shape[1] > 2 else a))
        # A parabola through three frames, a line through two.
        beyond = 3 * near - 3 * next_ + far if poses.shape[1] > 2 else 2 * near - next_
        turn = rotations.multiply(quaternion[:, a], rotations.conjugate(quaternion[:, b]))
        ends.append((beyond[:, None], rotations.multiply(turn, quaternion[:, a])[:, None]))
    position = np.concatenate([ends[0][0], position, ends[1][0]], 1)
    quaternion = np.concatenate([ends[0][1], quaternion, ends[1][1]], 1)
    velocity = np.gradient(position, axis=1, edge_order=2)
    first = np.clip(np.floor(times), -1, poses.shape[1] - 1).astype(int)
    part = (times - first)[..., None, None]
    inside = np.clip(part, 0.0, 1.0)

    def at(array: np.ndarray, k: int) -> np.ndarray:
        return np.take_along_axis(array, (first + 1 + k)[:, :, None, None], 1)

    p, q, v, w = at(position, 0), at(position, 1), at(velocity, 0), at(velocity, 1)
    s = inside
    place = (2 * s**3 - 3 * s**2 + 1) * p + (s**3 - 2 * s**2 + s) * v + (3 * s**2 - 2 * s**3) * q + (s**3 - s**2) * w
    place = place + (part - inside) * np.where(part > 1, w, v)
    start = at(quaternion, 0)
    turn = _logarithm(rotations.multiply(at(quaternion, 1), rotations.conjugate(start)))
    return np.concatenate([place, rotations.multiply(rotations.exponential(part * turn), start)], -1)


def _logarithm(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3"]:
    """The vector of a rotation, at most pi long [rad]."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def straightened(
    batch: SceneBatch,
    points: Float[np.ndarray, "batch points 2"],
    focal: Float[np.ndarray, "batch"],
    image: tuple[int, int],
) -> tuple[Float[np.ndarray, "batch points 2"], Bool[np.ndarray, "batch points"]]:
    """Points of the undistorted picture that are seen at ``points`` [px], by Newton's method, and whether there are any.

    A lens that shrinks the picture has a largest radius beyond which no light arrives. To 1e-6 px.
    """
    at = points.copy()
    determinant = trace = np.ones(points.shape[:2])
    step = 0.25
    for _ in range(30):
        wrong = acting.warped(batch, at, focal, image) - points
        columns = []
        for axis in ([step, 0.0], [0.0, step]):
            ahead, behind = (acting.warped(batch, at + sign * np.array(axis), focal, image) for sign in (1, -1))
            columns.append((ahead - behind) / (2 * step))
        (a, c), (b, d) = (np.moveaxis(column, -1, 0) for column in columns)
        determinant, trace = a * d - b * c, a + d
        safe = np.where(np.abs(determinant) < 1e-3, 1e-3, determinant)
        move = np.stack([d * wrong[..., 0] - b * wrong[..., 1], a * wrong[..., 1] - c * wrong[..., 0]], -1)
        move = move / safe[..., None]
        length = np.linalg.norm(move, axis=-1, keepdims=True)
        at = at - move * np.minimum(1.0, image[0] / np.maximum(length, 1e-9))
        if float(length.max(initial=0.0)) < 1e-7:
            break
    wrong = np.linalg.norm(acting.warped(batch, at, focal, image) - points, axis=-1)
    # Where the picture is not turned over, in neither direction.
    return at, (wrong < 1e-4) & (determinant > 0.0) & (trace > 0.0)
