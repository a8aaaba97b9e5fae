"""Meshes with normals and texture coordinates, and random textures that optical flow can hold on to."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8


def _grid(points: np.ndarray, normals: np.ndarray, texture: np.ndarray, start: int) -> tuple[list[str], int]:
    """A patch of (n, m) vertices as OBJ lines; faces wind so that the normals point outward."""
    lines = [f"v {p[0]:.7f} {p[1]:.7f} {p[2]:.7f}" for p in points.reshape(-1, 3)]
    lines += [f"vn {v[0]:.6f} {v[1]:.6f} {v[2]:.6f}" for v in normals.reshape(-1, 3)]
    lines += [f"vt {t[0]:.6f} {t[1]:.6f}" for t in texture.reshape(-1, 2)]
    n, m = points.shape[:2]
    for i in range(n - 1):
        for j in range(m - 1):
            a = start + i * m + j + 1
            b, c, d = a + 1, a + m + 1, a + m
            lines.append(f"f {a}/{a}/{a} {d}/{d}/{d} {c}/{c}/{c}")
            lines.append(f"f {a}/{a}/{a} {c}/{c}/{c} {b}/{b}/{b}")
    return lines, start + n * m


def _write(path: Path, patches: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Path:
    lines: list[str] = []
    start = 0
    for patch in patches:
        more, start = _grid(*patch, start)
        lines += more
    path.write_text("\n".join(lines) + "\n")
    return path


def _uv(n: int, m: int, box: tuple[float, float, float, float] = (0, 0, 1, 1)) -> np.ndarray:
    v, u = np.meshgrid(np.linspace(box[1], box[3], n), np.linspace(box[0], box[2], m), indexing="ij")
    return np.stack([u, v], -1)


def sphere(path: Path, rings: int = 48, sectors: int = 96) -> Path:
    """Unit sphere."""
    polar, turn = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, sectors + 1), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1)
    return _write(path, [(points, points, _uv(rings + 1, sectors + 1))])


def cylinder(path: Path, sectors: int = 96) -> Path:
    """Radius 1, height 2, axis z."""
    turn = np.linspace(0, 2 * np.pi, sectors + 1)
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    up = np.array([0.0, 0.0, 1.0])
    side = np.stack([ring + up, ring - up])
    patches = [(side, np.stack([ring, ring]), _uv(2, sectors + 1, (0, 0, 1, 0.5)))]
    for z, centre in ((1.0, 0.25), (-1.0, 0.75)):
        inner, outer = np.tile([0.0, 0, z], (sectors + 1, 1)), ring + z * up
        rows = np.stack([inner, outer] if z > 0 else [outer, inner])
        uv = np.stack([centre + 0.24 * rows[..., 0], 0.75 + 0.24 * rows[..., 1]], -1)
        patches.append((rows, np.broadcast_to(np.array([0.0, 0, z]), rows.shape), uv))
    return _write(path, patches)


def box(path: Path) -> Path:
    """Half extents 1."""
    patches = []
    for face in range(6):
        axis, sign = face % 3, 1 - 2 * (face // 3)
        normal = np.zeros(3)
        normal[axis] = sign
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3] * sign
        points = np.stack([np.stack([normal + a * u + b * v for a in (-1, 1)]) for b in (1, -1)])
        x, y = (face % 3) / 3, (face // 3) / 2
        uv = _uv(2, 2, (x + 0.01, y + 0.01, x + 0.32, y + 0.49))
        patches.append((points, np.broadcast_to(normal, points.shape), uv))
    return _write(path, patches)


def floor(path: Path, half: float = 14.0, cells: int = 28) -> Path:
    """A square about (0, half - 4) at z = 0; cells keep perspective and light exact enough."""
    line = np.linspace(-half, half, cells + 1)
    y, x = np.meshgrid(line[::-1] + half - 4, line, indexing="ij")
    points = np.stack([x, y, 0 * x], -1)
    return _write(path, [(points, np.broadcast_to([0.0, 0, 1], points.shape), _uv(cells + 1, cells + 1))])


def texture(
    rng: np.random.Generator, size: int, tint: tuple[float, float, float], checker: int, finest: int, contrast: float
) -> UInt8[np.ndarray, "size size 3"]:
    """Noise of several scales, over a checkerboard where `checker` > 0.

    Args:
      size: pixels a side. tint: mean colour, 0 to 255. checker: squares a side.
      finest: cells a side of the finest noise. contrast: standard deviation of grey, about.
    """
    picture = np.zeros((size, size, 3), np.float32) + np.asarray(tint, np.float32)
    cells = finest
    for share in (1.0, 1.0, 0.7, 0.5):
        cells = max(cells, 2)
        noise = rng.normal(size=(cells, cells, 1)) + 0.4 * rng.normal(size=(cells, cells, 3))
        picture += contrast * share * cv2.resize(noise.astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
        cells //= 4
    if checker:
        i = np.arange(size) * checker // size
        picture *= np.where((i[:, None] + i[None]) % 2, 1.15, 0.8)[..., None].astype(np.float32)
    return np.clip(picture, 5, 250).astype(np.uint8)
