"""The pinhole camera of a scene entry: projection, rays, and PyBullet's matrices for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Camera:
    """A pinhole camera turned about world x only.

    Fields:
      position: optical centre in the world, shape (3,), m.
      pitch: degrees; 0 looks straight down, 90 looks along +y.
      fovy: vertical field of view, degrees.
      width, height: pixels. Row r, column c has its centre at (c + 0.5, r + 0.5); the principal point is the centre.
    """

    position: tuple[float, float, float]
    pitch: float
    fovy: float
    width: int = 480
    height: int = 320

    @classmethod
    def of(cls, entries: list[dict[str, Any]], width: int = 480, height: int = 320) -> Camera:
        """The camera entry of a scene."""
        entry = next(e for e in entries if e["type"] == "camera")
        x, y, z = (float(v) for v in entry["position"])
        return cls((x, y, z), float(entry["orientation"]), float(entry["fovy"]), width, height)

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return self.height / 2 / float(np.tan(np.radians(self.fovy) / 2))

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Camera to world; the camera looks along its -z, y is up in the picture."""
        c, s = np.cos(np.radians(self.pitch)), np.sin(np.radians(self.pitch))
        return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """World points [m] to image coordinates and depth along the optical axis: (x px, y px, depth m)."""
        local = (np.asarray(points, float) - np.array(self.position)) @ self.rotation
        depth = -local[..., 2]
        x = self.width / 2 + self.focal * local[..., 0] / depth
        y = self.height / 2 - self.focal * local[..., 1] / depth
        return np.stack([x, y, depth], -1)

    def rays(self, image: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Unit directions in the world through image coordinates (x, y)."""
        image = np.asarray(image, float)
        x = (image[..., 0] - self.width / 2) / self.focal
        y = -(image[..., 1] - self.height / 2) / self.focal
        local = np.stack([x, y, -np.ones_like(x)], -1)
        return (local / np.linalg.norm(local, axis=-1, keepdims=True)) @ self.rotation.T

    def pixel_rays(self) -> Float[np.ndarray, "height width 3"]:
        """Unit directions through all pixel centres."""
        rows, columns = np.mgrid[0 : self.height, 0 : self.width]
        return self.rays(np.stack([columns + 0.5, rows + 0.5], -1))

    def on_plane(self, image: Float[np.ndarray, "2"], z: float) -> Float[np.ndarray, "3"]:
        """Where the ray through (x, y) meets the horizontal plane at height z; the ray must look down."""
        ray = self.rays(image)
        return np.array(self.position) + ray * (z - self.position[2]) / ray[2]

    def view_matrix(self) -> list[float]:
        """World to camera, 4x4, column by column as OpenGL and PyBullet want it."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.T
        matrix[:3, 3] = -self.rotation.T @ np.array(self.position)
        return matrix.T.flatten().tolist()

    def projection_matrix(self, near: float = 0.05, far: float = 100.0, shift: float = 0.5) -> list[float]:
        """OpenGL projection, 4x4, column by column.

        TinyRenderer samples pixel (r, c) at (c, r + 1) in image coordinates, not at the pixel's centre; `shift`
        half a pixel in both axes moves its samples to the centres (checked against an analytic sphere).
        """
        f = 2 * self.focal / self.height
        matrix = np.zeros((4, 4))
        matrix[0, 0] = f * self.height / self.width
        matrix[1, 1] = f
        matrix[0, 2] = 2 * shift / self.width
        matrix[1, 2] = 2 * shift / self.height
        matrix[2, 2] = (far + near) / (near - far)
        matrix[2, 3] = 2 * far * near / (near - far)
        matrix[3, 2] = -1.0
        return matrix.T.flatten().tolist()
