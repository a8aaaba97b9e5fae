"""The exam's effects: which motion suits each, how large it may be, and how one is drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.withheld import forces
from benchmarks.withheld.effect import Effect
from benchmarks.withheld.stage import FRAMES, SIZE, Stage
from benchmarks.withheld.view import FPS

SECONDS = (FRAMES - 1) / FPS
Rule = Callable[[float], Effect | None]
Drawing = Callable[[np.random.Generator, Stage], Rule | None]
ALL = ("flight", "slide", "roll", "bounce", "collision")


@dataclass(frozen=True)
class Family:
    """One kind of effect.

    Fields:
      kinds: motions that suit it. span: least and greatest strength. draw: all but the strength, or None if the scene
      does not suit. pixels: range of the displacement that is aimed at. seen: what is displaced, `objects`,
      `picture`, `width` (the strength is the displacement) or `hidden` (a rectangle). accepts: other right answers.
    """

    kinds: tuple[str, ...]
    span: tuple[float, float]
    draw: Drawing
    pixels: tuple[float, float] = (3.0, 40.0)
    seen: str = "objects"
    accepts: tuple[str, ...] = ()


def _unit(rng: np.random.Generator, size: int) -> Float[np.ndarray, "size"]:
    v = rng.normal(size=size)
    return v / np.linalg.norm(v)


def _push_way(rng: np.random.Generator, stage: Stage) -> Float[np.ndarray, "3"]:
    """A direction for a force: mostly level for bodies on the floor."""
    way = _unit(rng, 3)
    way[2] *= 1.0 if stage.kind in ("flight", "bounce") else 0.15
    return way / np.linalg.norm(way)


def _xyz(v: Float[np.ndarray, "3"]) -> dict[str, float]:
    return {k: float(x) for k, x in zip("xyz", v, strict=True)}


def _mass(stage: Stage) -> float:
    return stage.objects[0]["physics"]["mass"]


def _drag(rng: np.random.Generator, stage: Stage) -> Rule:
    share, mass = float(rng.choice([0.0, 0.0, 1.0, 0.5])), _mass(stage)

    def rule(s: float) -> Effect:
        return Effect("drag", 0, {"linear": share * s * mass * 2, "quadratic": (1 - share) * s * mass})

    return rule


def _magnus(rng: np.random.Generator, stage: Stage) -> Rule:
    return lambda s: Effect("magnus", 0, {"coefficient": s * _mass(stage)})


def _wind(rng: np.random.Generator, stage: Stage) -> Rule:
    way = _unit(rng, 2)

    def rule(s: float) -> Effect:
        pressure = forces.pressure(stage.objects[0], s * way)
        return Effect("wind", None, {"x": float(pressure[0]), "y": float(pressure[1])}, {"wind": (s * way).tolist()})

    return rule


def _push(rng: np.random.Generator, stage: Stage) -> Rule:
    time, way, mass = float(rng.uniform(0.15, 0.75)), _push_way(rng, stage), _mass(stage)
    if stage.kind in ("slide", "roll", "collision"):
        way[2] = 0.0
    return lambda s: Effect("push", 0, {"time": time, **_xyz(s * mass * way)})


def _slope(rng: np.random.Generator, stage: Stage) -> Rule:
    way = _unit(rng, 2)
    return lambda s: Effect("slope", None, {"x": float(s * way[0]), "y": float(s * way[1])})


def _path(stage: Stage, time: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Place and velocity of the first object without effects."""
    places = stage.track.at(np.array([time - 0.01, time, time + 0.01]), 0)[0]
    return places[1], (places[2] - places[0]) / 0.02


def _patch(rng: np.random.Generator, stage: Stage) -> Rule:
    centre = _path(stage, float(rng.uniform(0.2, 0.7)))[0][:2] + rng.normal(0, 0.1, 2)
    radius, sign = float(rng.uniform(0.25, 0.8)), float(rng.choice([-1, 1, 1]))
    friction = stage.objects[0]["physics"]["friction"][0]

    def rule(s: float) -> Effect:
        values = {"x": float(centre[0]), "y": float(centre[1]), "radius": radius}
        return Effect("friction_patch", None, {**values, "friction": float(friction * np.exp(sign * s))})

    return rule


def _offset(rng: np.random.Generator, stage: Stage) -> Rule | None:
    from benchmarks.withheld.solids import half_extents

    way, half = _unit(rng, 3), half_extents(stage.objects[0])
    return lambda s: Effect("offset_com", 0, _xyz(s * way * half))


def _obstacle(rng: np.random.Generator, stage: Stage) -> Rule:
    from benchmarks.withheld import solids

    post = bool(rng.random() < 0.5)
    form, radius = ("post", float(rng.uniform(0.05, 0.15))) if post else ("box", float(rng.uniform(0.05, 0.1)))
    breadth, aside = float(rng.uniform(0.3, 0.8)), float(np.radians(rng.uniform(-55, 55)))
    points = solids.of(stage.objects[0]).points

    def rule(s: float) -> Effect | None:
        time = SECONDS * (1 - s)
        place, velocity = _path(stage, time)
        if np.linalg.norm(velocity[:2]) < 0.4:
            return None
        angle = float(np.arctan2(velocity[1], velocity[0]) + aside)
        way = np.array([np.cos(angle), np.sin(angle)])
        turn = stage.track.at(np.array(time), 0)[1]
        extent = float(((points @ turn.T)[:, :2] @ way).max())
        centre = place[:2] + way * (extent + radius)
        hidden = {"form": form, "radius": radius, "breadth": breadth, "turn": angle, "place": centre.tolist()}
        return Effect("hidden_obstacle", 0, {}, hidden)  # angle and distance are read off the first hit

    return rule


def _motion(rng: np.random.Generator, stage: Stage) -> Rule:
    mode, turn, way = str(rng.choice(["turn", "travel", "both"])), _unit(rng, 2), _unit(rng, 3)
    turn = turn * (mode != "travel")
    # A metre and twenty degrees move the picture about as far.
    way = way * (mode != "turn") / 20

    def rule(s: float) -> Effect:
        return Effect("camera_motion", None, {"pan": float(s * turn[0]), "tilt": float(s * turn[1]), **_xyz(s * way)})

    return rule


def _shake(rng: np.random.Generator, stage: Stage) -> Rule:
    jitter = rng.normal(size=(2, FRAMES))
    jitter[:, 1:] = 0.9 * jitter[:, 1:] + 0.4 * jitter[:, :-1]
    jitter -= jitter.mean(1, keepdims=True)
    jitter /= np.sqrt((jitter**2).mean())

    def rule(s: float) -> Effect:
        yaw, pitch = s * jitter
        return Effect("camera_shake", None, {"yaw": yaw.tolist(), "pitch": pitch.tolist(), "amplitude": float(s)})

    return rule


def _signed(name: str, key: str) -> Drawing:
    def draw(rng: np.random.Generator, stage: Stage) -> Rule:
        sign = float(rng.choice([-1, 1]))
        return lambda s: Effect(name, None, {key: sign * s})

    return draw


def _lens(rng: np.random.Generator, stage: Stage) -> Rule:
    sign = float(rng.choice([-1, 1]))
    far = float(np.hypot(*SIZE)) / 2 / stage.camera.focal

    def rule(s: float) -> Effect | None:
        # A barrel that folds back inside the picture is no lens.
        return None if sign < 0 and s * far**2 * 6.75 > 0.8 else Effect("lens_distortion", None, {"k1": sign * s})

    return rule


def _rolling(rng: np.random.Generator, stage: Stage) -> Rule:
    return lambda s: Effect("rolling_shutter", None, {"readout": s})


def _dropped(rng: np.random.Generator, stage: Stage) -> Rule:
    frame, sign = int(rng.integers(6, FRAMES * 11 // 15)), int(rng.choice([-1, 1]))
    return lambda s: Effect("dropped_frames", None, {"frame": frame, "count": sign * round(s)})


def _occluder(rng: np.random.Generator, stage: Stage) -> Rule:
    frame, side = int(rng.integers(6, FRAMES * 4 // 5)), int(rng.integers(4))
    reach = stage.base.outlines[frame, 0]
    left, right, top, bottom = -reach[8], reach[0], -reach[12], reach[4]
    before, after, depth = rng.uniform(0.2, 0.9, 3) * max(right - left, bottom - top)

    def rule(s: float) -> Effect:
        boxes = [
            (left - 10 - depth, top - before, left + s, bottom + after),
            (right - s, top - before, right + 10 + depth, bottom + after),
            (left - before, top - 10 - depth, right + after, top + s),
            (left - before, bottom - s, right + after, bottom + 10 + depth),
        ]
        names = ("left", "top", "right", "bottom")
        low = np.clip(np.round(boxes[side]), 0, [SIZE[0], SIZE[1]] * 2)
        return Effect("occluder", None, {k: float(v) for k, v in zip(names, low, strict=True)})

    return rule


def _shape(rng: np.random.Generator, stage: Stage) -> Rule:
    kind = stage.objects[0]["type"]
    form = str(rng.choice({"sphere": ["ellipsoid"]}.get(kind, ["ellipsoid", "rounded", "tapered"])))
    lean = rng.permutation([1.0, -0.8, rng.uniform(-0.6, 0.6)]).tolist()
    if form == "ellipsoid" and kind != "sphere":
        lean = (0.5 * np.asarray(lean)).tolist()
    return lambda s: Effect("shape", 0, {}, {"form": form, "strength": s, "lean": lean})


CATALOGUE: dict[str, Family] = {
    "drag": Family(("flight", "slide", "roll"), (0.01, 1.5), _drag),
    "magnus": Family(("flight",), (0.003, 0.4), _magnus),
    "wind": Family(("flight", "roll", "slide", "bounce"), (4.0, 10.0), _wind),
    "push": Family(ALL, (0.05, 3.0), _push),
    "slope": Family(("slide", "roll", "bounce"), (0.1, 8.0), _slope),
    "friction_patch": Family(("slide",), (0.1, 2.5), _patch),
    "offset_com": Family(("flight", "roll"), (0.03, 0.6), _offset),
    "hidden_obstacle": Family(("slide", "roll", "flight", "bounce"), (0.05, 0.9), _obstacle),
    "camera_motion": Family(ALL, (0.2, 12.0), _motion, seen="picture"),
    "camera_shake": Family(ALL, (0.1, 3.0), _shake, seen="picture"),
    "camera_roll": Family(ALL, (0.4, 10.0), _signed("camera_roll", "angle"), seen="picture"),
    "lens_distortion": Family(ALL, (0.005, 0.6), _lens, seen="picture"),
    "rolling_shutter": Family(("flight", "slide", "collision", "bounce"), (0.004, 0.0333), _rolling, pixels=(3.0, 8.0)),
    "dropped_frames": Family(("flight", "slide", "roll", "bounce"), (1.0, 6.0), _dropped, seen="count"),
    "mask_bias": Family(ALL, (3.0, 10.0), _signed("mask_bias", "width"), pixels=(3.0, 10.0), seen="width"),
    "occluder": Family(("flight", "slide", "roll"), (2.0, 80.0), _occluder, seen="hidden"),
    "shape": Family(("flight", "slide", "roll", "bounce"), (0.05, 1.0), _shape, pixels=(3.0, 10.0)),
}


def _spring(rng: np.random.Generator, stage: Stage) -> Rule:
    point = _path(stage, 0.5)[0] + np.array([*rng.normal(0, 0.7, 2), 0.0])
    return lambda s: Effect("spring", 0, {**_xyz(point), "stiffness": s * _mass(stage)})


def _periodic(rng: np.random.Generator, stage: Stage) -> Rule:
    way, beat = np.array([*_unit(rng, 2), 0.0]), float(rng.uniform(1.5, 3.5))
    return lambda s: Effect("periodic_force", 0, {**_xyz(s * _mass(stage) * way), "frequency": beat})


def _growing(rng: np.random.Generator, stage: Stage) -> Rule:
    way = np.array([*_unit(rng, 2), 0.0])
    return lambda s: Effect("growing_force", 0, _xyz(s * _mass(stage) * way))


def _flip(rng: np.random.Generator, stage: Stage) -> Rule:
    share = float(rng.choice([1.0, 2.0]))  # gone, or turned over
    return lambda s: Effect("gravity_flip", None, {"time": SECONDS * (1 - s), "share": share})


def _vortex(rng: np.random.Generator, stage: Stage) -> Rule:
    centre = _path(stage, 0.5)[0][:2] + rng.normal(0, 0.4, 2)
    values = {"x": float(centre[0]), "y": float(centre[1])}
    return lambda s: Effect("vortex", 0, {**values, "strength": s * _mass(stage)})


def _shrinking(rng: np.random.Generator, stage: Stage) -> Rule:
    return lambda s: Effect("shrinking", 0, {"rate": s})


def _teleport(rng: np.random.Generator, stage: Stage) -> Rule:
    time = float(rng.integers(100, 360)) / 480 * FRAMES / FPS
    velocity = _path(stage, time)[1]
    aside = np.array([-velocity[1], velocity[0], 0.0]) * rng.choice([-1, 1])
    way = aside / (np.linalg.norm(aside) + 1e-9)
    return lambda s: Effect("teleport", 0, {"time": time, **_xyz(s * way)})


STRANGE: dict[str, Family] = {
    "spring": Family(("flight", "slide", "roll"), (0.3, 40.0), _spring, pixels=(8.0, 40.0)),
    "periodic_force": Family(("flight", "slide", "roll"), (0.5, 60.0), _periodic, pixels=(5.0, 40.0)),
    "growing_force": Family(("flight", "slide", "roll"), (0.5, 60.0), _growing, (8.0, 40.0), accepts=("wind",)),
    "gravity_flip": Family(("flight", "bounce"), (0.05, 0.7), _flip, pixels=(10.0, 40.0)),
    "vortex": Family(("flight", "slide", "roll"), (0.1, 30.0), _vortex, pixels=(8.0, 40.0)),
    "shrinking": Family(("flight", "slide", "roll"), (0.05, 2.0), _shrinking, (5.0, 20.0), accepts=("shape",)),
    "teleport": Family(("flight", "slide", "roll"), (0.01, 0.6), _teleport, pixels=(6.0, 40.0)),
}

# Effects that leave traces of different kinds, so that both can be told.
PAIRS: tuple[tuple[str, str], ...] = (
    ("drag", "camera_roll"),
    ("magnus", "mask_bias"),
    ("push", "camera_motion"),
    ("friction_patch", "camera_shake"),
    ("slope", "dropped_frames"),
    ("wind", "push"),
    ("hidden_obstacle", "camera_motion"),
    ("push", "mask_bias"),
    ("drag", "camera_shake"),
    ("offset_com", "camera_motion"),
    ("wind", "shape"),
    ("drag", "dropped_frames"),
)
