"""Quaternions (w x y z) in numpy, batched over leading axes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def multiply(p: Float[np.ndarray, "*batch 4"], q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """Hamilton product: first ``q``, then ``p``."""
    a, b, c, d = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    result = np.empty(np.broadcast_shapes(p.shape, q.shape), np.result_type(p, q))
    result[..., 0] = a * w - b * x - c * y - d * z
    result[..., 1] = a * x + b * w + c * z - d * y
    result[..., 2] = a * y - b * z + c * w + d * x
    result[..., 3] = a * z + b * y - c * x + d * w
    return result


def exponential(vector: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 4"]:
    """The rotation about ``vector`` by its length [rad]; regular at zero."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), vector * (np.sinc(angle / (2 * np.pi)) / 2)], -1)


def matrix(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices of unit quaternions."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    result = np.empty((*q.shape[:-1], 3, 3), q.dtype)
    result[..., 0, 0] = 1 - 2 * (y * y + z * z)
    result[..., 1, 1] = 1 - 2 * (x * x + z * z)
    result[..., 2, 2] = 1 - 2 * (x * x + y * y)
    for i, j, product, turn in ((0, 1, x * y, w * z), (1, 2, y * z, w * x), (2, 0, x * z, w * y)):
        result[..., i, j], result[..., j, i] = 2 * (product - turn), 2 * (product + turn)
    return result


def rotate(q: Float[np.ndarray, "*batch 4"], v: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """``v`` rotated by ``q``."""
    return turned(matrix(q), v)


def turned(axes: Float[np.ndarray, "*batch 3 3"], v: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """``v`` rotated by matrices."""
    return (axes * v[..., None, :]).sum(-1)


def conjugate(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """The inverse of a unit quaternion."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def normalise(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions of the same direction."""
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def length(v: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """``np.linalg.norm`` of few vectors, in less time."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.sqrt(x * x + y * y + z * z)


def cross(a: Float[np.ndarray, "*batch 3"], b: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """``np.cross``, which takes longer to look at its axes than to multiply a few vectors."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    result = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
    result[..., 0], result[..., 1], result[..., 2] = y * w - z * v, z * u - x * w, x * v - y * u
    return result
