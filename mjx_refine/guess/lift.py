"""From pixels to metres: rays, back-projection onto the floor, free flight, and sizes from widths of outlines."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from mjx_refine import rotations
from mjx_refine.scene import Camera, Shape
from mjx_refine.view.outline import directions


@dataclasses.dataclass(frozen=True)
class Lens:
    """A camera's direction and focal length, without a place.

    Attributes:
      pitch: about the world's x axis, 0 looks straight down [rad].
      fovy: vertical field of view [rad].
      size: (width, height) [px].
    """

    pitch: float
    fovy: float
    size: tuple[int, int]

    @property
    def focal(self) -> float:
        """Focal length [px]."""
        return self.size[1] / 2 / math.tan(self.fovy / 2)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Camera to world; the camera looks along its -z, y up in the picture."""
        c, s = math.cos(self.pitch), math.sin(self.pitch)
        return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])

    def slopes(self, pixel: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """(u, v): the ray of a pixel in camera coordinates is (u, v, -1)."""
        return (pixel - np.array(self.size) / 2) * np.array([1.0, -1.0]) / self.focal

    def rays(self, pixel: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """World directions of pixels' rays, of depth 1."""
        slopes = self.slopes(pixel)
        return np.concatenate([slopes, -np.ones_like(slopes[..., :1])], -1) @ self.matrix.T

    def camera(self, position: np.ndarray) -> Camera:
        """The scene's camera."""
        x, y, z = (float(p) for p in position)
        return Camera((x, y, z), math.degrees(self.pitch), math.degrees(self.fovy))


def onto_plane(lens: Lens, pixel: Float[np.ndarray, "*n 2"], below: float) -> Float[np.ndarray, "*n 3"] | None:
    """Points, relative to the camera, at which rays meet the horizontal plane ``below`` it [m]; None above the horizon."""
    rays = lens.rays(pixel)
    if (rays[..., 2] > -0.02).any():
        return None
    return rays * (-below / rays[..., 2:])


@dataclasses.dataclass(frozen=True)
class Flight:
    """Free flight relative to the camera: place [m] and velocity [m/s] at the first frame, metres a pixel at depth 1."""

    position: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]

    def at(self, seconds: np.ndarray | float, gravity: np.ndarray) -> np.ndarray:
        """Places [m]."""
        t = np.asarray(seconds, np.float64)[..., None]
        return self.position + self.velocity * t + gravity * t * t / 2


def fly(
    lens: Lens, pixel: np.ndarray, seconds: np.ndarray, width: np.ndarray, gravity: np.ndarray, trust: float
) -> Flight | None:
    """The free flight under ``gravity`` that projects onto a track: linear least squares.

    With P(t) = p + v t + g t^2 / 2 in camera coordinates and depth d = -P_z, each frame says P_x = u d, P_y = v d, and that
    width times depth is one unknown number S. All are linear in (p, v, S).

    Args:
      width: mean width of the outline by frame, NaN where unknown [px].
      trust: weight of widths against places; small where the outline changes as the object turns.

    Returns:
      None where the fit ends behind the camera.
    """
    slopes, down = lens.slopes(pixel), lens.matrix.T @ gravity
    rows, right = [], []
    for (u, v), t, w in zip(slopes, seconds, width, strict=True):
        basis = np.array([1.0, t])
        fall = down * t * t / 2
        for axis, slope in ((0, u), (1, v)):
            row = np.zeros(7)
            row[[axis, axis + 3]] = basis
            row[[2, 5]] = slope * basis
            rows.append(row * lens.focal)
            right.append(-(fall[axis] + slope * fall[2]) * lens.focal)
        if np.isfinite(w):
            row = np.zeros(7)
            row[[2, 5]] = -w * basis
            row[6] = -lens.focal / 10
            rows.append(trust * row)
            right.append(trust * w * fall[2])
    # What nothing tells, motion towards the camera, is nought.
    row = np.zeros(7)
    row[5] = 1.0
    rows.append(row)
    right.append(0.0)
    solution = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    position, velocity = lens.matrix @ solution[:3], lens.matrix @ solution[3:6]
    depth = -(solution[2] + solution[5] * seconds + down[2] * seconds**2 / 2)
    if not np.isfinite(solution).all() or depth.min() < 0.05 or depth.max() > 200.0:
        return None
    return Flight(position, velocity)


@dataclasses.dataclass(frozen=True)
class Form:
    """A primitive with its size [px of the outline] and orientation; ``misfit`` of its outline, relative."""

    shape: Shape
    size: tuple[float, ...]
    quaternion: tuple[float, float, float, float]
    misfit: float

    @property
    def below(self) -> float:
        """How far it reaches below its centre [px]."""
        return extent_below(self)


def extent_below(form: Form) -> float:
    """Half of the vertical extent [px]."""
    if form.shape == "sphere":
        return form.size[0]
    row = np.abs(rotations.matrix(np.array(form.quaternion))[2])
    if form.shape == "box":
        return float(row @ np.array(form.size))
    return float(row[2] * form.size[1] / 2 + math.sqrt(max(1 - row[2] ** 2, 0.0)) * form.size[0])


YAWS = np.deg2rad(np.arange(0.0, 180.0, 10.0))


def yawed(yaw: float, lying: bool = False) -> tuple[float, float, float, float]:
    """Turned by ``yaw`` about z; ``lying`` puts the body's z axis along the x direction first."""
    turn = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
    if lying:
        w, _, _, z = turn
        h = math.sqrt(0.5)
        turn = np.array([w * h, -z * h, w * h, z * h])
    return tuple(float(v) for v in turn)  # type: ignore[return-value]


def sphere_form(area: float) -> Form:
    """A sphere by its area [px^2]."""
    return Form("sphere", (math.sqrt(max(area, 1.0) / math.pi),), (1.0, 0.0, 0.0, 0.0), 0.0)


def fit_forms(lens: Lens, sight: np.ndarray, widths: np.ndarray, shape: str, turned: bool = False) -> list[Form]:
    """Primitives whose parallel projection has the given widths, best first.

    A convex body's width along n is linear in its half extents: a box has 2 sum_k s_k |n . e_k|, a cylinder
    2 r |n - (n . a) a| + h |n . a|; so each orientation takes one small least squares with s >= 0.

    Args:
      sight: unit direction from the camera to the object, world frame.
      shape: ``box``, ``upright`` or ``lying`` (cylinders).
      turned: whether boxes may also be turned about the line of sight (in the air).
    """
    normals = directions(16)[:8] * np.array([1.0, -1.0])
    world = np.concatenate([normals, np.zeros((8, 1))], -1) @ lens.matrix.T
    world = world - (world @ sight)[:, None] * sight
    world /= np.linalg.norm(world, axis=-1, keepdims=True)
    quaternions = [yawed(0.0)] if shape == "upright" else [yawed(y, shape == "lying") for y in YAWS]
    if shape == "box":
        quaternions = quaternions[:9]
        if turned:
            quaternions += [_about(-sight, a) for a in YAWS[:9]]
    forms = []
    for quaternion in quaternions:
        axes = rotations.matrix(np.array(quaternion)).T
        cosine = np.abs(world @ axes.T)
        if shape == "box":
            columns = 2 * cosine
        else:
            columns = np.stack([2 * np.sqrt(1 - np.minimum(cosine[:, 2], 1.0) ** 2), 2 * cosine[:, 2]], -1)
        solution, misfit = _sizes(columns, widths)
        size = tuple(solution) if shape == "box" else (solution[0], 2 * solution[1])
        forms.append(Form("box" if shape == "box" else "cylinder", size, quaternion, misfit))
    return sorted(forms, key=lambda form: form.misfit)


def _sizes(columns: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, float]:
    """Half extents >= a seventh of the typical one, drawn weakly to each other where the outline does not tell."""
    count, scale = columns.shape[1], float(widths.mean()) / 2
    low = scale / 7
    # A body that shows one side only: as thick as its narrower side.
    ties = 0.05 * np.eye(count)
    target = np.concatenate([widths - columns @ np.full(count, low), 0.05 * np.full(count, 0.7 * scale - low)])
    solution = nnls(np.concatenate([columns, ties]), target)[0] + low
    misfit = np.sqrt(np.mean((columns @ solution - widths) ** 2)) / max(float(widths.mean()), 1e-9)
    return solution, float(misfit)


def _about(axis: np.ndarray, angle: float) -> tuple[float, float, float, float]:
    x, y, z = axis * math.sin(angle / 2)
    return (math.cos(angle / 2), float(x), float(y), float(z))
