"""What is drawn: convex solids about their own origin, met by rays, with points on their surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "*n 3"]
FAR = np.inf
STEPS, HALVINGS = 40, 24


@dataclass(frozen=True)
class Solid:
    """A convex solid {p : level(p) <= 1}.

    Fields:
      level: the solid's gauge; 1 on the surface, growing outward along every ray from the origin.
      points: on the surface, (n, 3) m; their hull is the solid's to a fraction of a per cent.
      meet: distances along rays (origins, directions) at which they enter, in lengths of the direction; inf: never.
    """

    level: Callable[[Points], Float[np.ndarray, "*n"]]
    points: Float[np.ndarray, "points 3"]
    meet: Callable[[Points, Points], Float[np.ndarray, "*n"]]

    def normal(self, points: Points) -> Points:
        """Outward unit normals at points on the surface, by differences of the gauge."""
        step = 1e-4 * np.eye(3)
        slope = np.stack([self.level(points + e) - self.level(points - e) for e in step], -1)
        return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12)


def of(entry: dict[str, Any]) -> Solid:
    """The primitive of a scene's entry."""
    if entry["type"] == "sphere":
        return _ellipsoid(np.full(3, float(entry["radius"])))
    if entry["type"] == "box":
        return _box(np.asarray(entry["size"], float))
    return _cylinder(float(entry["radius"]), float(entry["height"]) / 2)


def half_extents(entry: dict[str, Any]) -> Float[np.ndarray, "3"]:
    """Half the sides of the primitive's own bounding box, m."""
    if entry["type"] == "sphere":
        return np.full(3, float(entry["radius"]))
    if entry["type"] == "box":
        return np.asarray(entry["size"], float)
    return np.array([entry["radius"], entry["radius"], entry["height"] / 2], float)


def another(entry: dict[str, Any], form: str, strength: float, lean: Float[np.ndarray, "3"]) -> Solid:
    """A solid that is not the entry's primitive.

    Args:
      form: `ellipsoid` (axes stretched unevenly), `rounded` (edges and caps worn down) or `tapered` (thinner upward).
      strength: 0 (the primitive, nearly) to 1. lean: how each axis of an ellipsoid is stretched, about -1 to 1.

    Raises:
      ValueError: unknown form.
    """
    half = half_extents(entry)
    if form == "ellipsoid":
        return _ellipsoid(half * (1 + strength * lean))
    if form == "rounded":
        power = 2 / max(strength, 0.05)
        if entry["type"] == "cylinder":

            def worn(p: Points) -> Float[np.ndarray, "*n"]:
                rho, z = np.hypot(p[..., 0], p[..., 1]) / half[0], np.abs(p[..., 2]) / half[2]
                return (rho**power + z**power) ** (1 / power)
        else:

            def worn(p: Points) -> Float[np.ndarray, "*n"]:
                return (np.abs(p / half) ** power).sum(-1) ** (1 / power)

        return _implicit(worn)
    if form != "tapered":
        raise ValueError(f"form = {form!r}; expected ellipsoid, rounded or tapered")

    def tapered(p: Points) -> Float[np.ndarray, "*n"]:
        # In the plane of height z the outline is scaled by 1 - strength z / half; as a gauge: linear in p.
        across = _across(entry, p, half) + 0.9 * strength * p[..., 2] / half[2]
        return np.maximum(across, np.abs(p[..., 2]) / half[2])

    return _implicit(tapered)


def _across(entry: dict[str, Any], p: Points, half: Float[np.ndarray, "3"]) -> Float[np.ndarray, "*n"]:
    flat = np.abs(p[..., :2] / half[:2])
    return flat.max(-1) if entry["type"] == "box" else np.hypot(flat[..., 0], flat[..., 1])


def directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Directions spread evenly over the sphere (Fibonacci's spiral)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    rho = np.sqrt(1 - z * z)
    return np.stack([rho * np.cos(turn), rho * np.sin(turn), z], -1)


def _ellipsoid(axes: Float[np.ndarray, "3"]) -> Solid:
    def level(p: Points) -> Float[np.ndarray, "*n"]:
        return np.linalg.norm(p / axes, axis=-1)

    def meet(o: Points, d: Points) -> Float[np.ndarray, "*n"]:
        o, d = o / axes, d / axes
        a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
        root = b * b - a * c
        return np.where(root >= 0, (-b - np.sqrt(np.maximum(root, 0))) / a, FAR)

    return Solid(level, directions(900) * axes, meet)


def _box(half: Float[np.ndarray, "3"]) -> Solid:
    def level(p: Points) -> Float[np.ndarray, "*n"]:
        return np.abs(p / half).max(-1)

    def meet(o: Points, d: Points) -> Float[np.ndarray, "*n"]:
        enter, leave = _slabs(o, d, half)
        return np.where((enter <= leave) & (leave > 0), enter, FAR)

    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
    return Solid(level, corners * half, meet)


def _slabs(o: Points, d: Points, half: Float[np.ndarray, "k"]) -> tuple[np.ndarray, np.ndarray]:
    inverse = 1 / np.where(np.abs(d) < 1e-12, 1e-12, d)
    a, b = (-half - o) * inverse, (half - o) * inverse
    return np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)


def _cylinder(radius: float, half: float) -> Solid:
    def level(p: Points) -> Float[np.ndarray, "*n"]:
        return np.maximum(np.hypot(p[..., 0], p[..., 1]) / radius, np.abs(p[..., 2]) / half)

    def meet(o: Points, d: Points) -> Float[np.ndarray, "*n"]:
        a = np.maximum((d[..., :2] ** 2).sum(-1), 1e-18)
        b, c = (o[..., :2] * d[..., :2]).sum(-1), (o[..., :2] ** 2).sum(-1) - radius**2
        root = b * b - a * c
        wide = np.sqrt(np.maximum(root, 0))
        low, high = _slabs(o[..., 2:], d[..., 2:], np.array([half]))
        enter, leave = np.maximum(low, (-b - wide) / a), np.minimum(high, (-b + wide) / a)
        return np.where((root >= 0) & (enter <= leave) & (leave > 0), enter, FAR)

    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn)], -1)
    points = np.concatenate([np.c_[ring, np.full(64, z)] for z in (-half, half)])
    return Solid(level, points, meet)


def _implicit(level: Callable[[Points], Float[np.ndarray, "*n"]]) -> Solid:
    """A solid by its gauge alone: rays march through its bounding sphere and halve the last step."""
    way = directions(1600)
    reach = np.full(len(way), 1e-3)
    while (level(way * reach[:, None]) < 1).any():
        reach = np.where(level(way * reach[:, None]) < 1, reach * 1.2, reach)
    low, high = np.zeros_like(reach), reach
    for _ in range(40):
        middle = (low + high) / 2
        inside = level(way * middle[:, None]) < 1
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    points = way * high[:, None]
    bound = float(high.max()) * 1.01

    def meet(o: Points, d: Points) -> Float[np.ndarray, "*n"]:
        o = np.broadcast_to(o, d.shape)
        length = np.linalg.norm(d, axis=-1)
        nearest = -(o * d).sum(-1) / length**2
        chance = np.linalg.norm(o + nearest[..., None] * d, axis=-1) < bound
        out = np.full(d.shape[:-1], FAR)
        if not chance.any():
            return out
        o, d, nearest, span = o[chance], d[chance], nearest[chance], bound / length[chance]
        at = nearest[:, None] + span[:, None] * np.linspace(-1, 1, STEPS)
        inside = level(o[:, None] + at[..., None] * d[:, None]) <= 1
        hits, first = inside.any(1), inside.argmax(1)
        rows = np.arange(len(at))
        low, high = at[rows, np.maximum(first - 1, 0)], at[rows, first]
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            within = level(o + middle[:, None] * d) <= 1
            low, high = np.where(within, low, middle), np.where(within, middle, high)
        out[chance] = np.where(hits, high, FAR)
        return out

    return Solid(level, points, meet)
