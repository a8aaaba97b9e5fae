"""Quaternions (w, x, y, z), and how high a body's centre stands over its lowest point."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float


def matrix(quaternion: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 3 3"]:
    """Rotation matrices, body to world, of quaternions of any length but zero."""
    q = np.asarray(quaternion, float)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def about(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "4"]:
    """The rotation by `angle` rad about `axis`."""
    axis = np.asarray(axis, float)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis / np.linalg.norm(axis)])


def product(a: Float[np.ndarray, "4"], b: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """First b, then a."""
    w, v, s, u = a[0], np.asarray(a[1:]), b[0], np.asarray(b[1:])
    return np.concatenate([[w * s - v @ u], w * u + s * v + np.cross(v, u)])


def random(rng: np.random.Generator) -> Float[np.ndarray, "4"]:
    """A uniformly random orientation."""
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def half_height(entry: dict[str, Any], quaternion: Float[np.ndarray, "4"]) -> float:
    """Height of the body's centre over its lowest point, m, in the orientation given."""
    up = matrix(quaternion)[2]
    if entry["type"] == "sphere":
        return float(entry["radius"])
    if entry["type"] == "box":
        return float(np.abs(up) @ np.asarray(entry["size"], float))
    tilt = min(abs(float(up[2])), 1.0)
    return tilt * entry["height"] / 2 + entry["radius"] * float(np.sqrt(1 - tilt * tilt))


def bounding_radius(entry: dict[str, Any]) -> float:
    """Radius of the sphere about the body's centre that holds it, m."""
    if entry["type"] == "sphere":
        return float(entry["radius"])
    if entry["type"] == "box":
        return float(np.linalg.norm(entry["size"]))
    return float(np.hypot(entry["radius"], entry["height"] / 2))
