"""Forces of the effects, and of the strange ones that no catalogue has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pybullet
from jaxtyping import Float

from benchmarks.withheld.effect import Effect, named
from benchmarks.withheld.track import RATE

AIR = 1.2  # kg/m^3
SHAPE_DRAG = {"sphere": 0.47, "box": 1.05, "cylinder": 0.8}
PUSH_SECONDS = 1 / 60
Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True)
class State:
    """Of one body, in the world frame: centre of mass m, w x y z, m/s, rad/s."""

    position: Vector
    quaternion: Float[np.ndarray, "4"]
    velocity: Vector
    spin: Vector


def area(entry: dict[str, Any]) -> float:
    """Mean area that a convex body shows over all directions: a quarter of its surface (Cauchy), m^2."""
    if entry["type"] == "sphere":
        return float(np.pi * entry["radius"] ** 2)
    if entry["type"] == "box":
        a, b, c = entry["size"]
        return float(2 * (a * b + b * c + c * a))
    r, h = entry["radius"], entry["height"]
    return float((2 * np.pi * r * r + 2 * np.pi * r * h) / 4)


def pressure(entry: dict[str, Any], wind: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """What wind presses a resting body with, Pa: 0.5 rho Cd |u| u."""
    return 0.5 * AIR * SHAPE_DRAG[entry["type"]] * np.linalg.norm(wind) * wind


def force(
    effect: Effect, index: int, entry: dict[str, Any], time: float, state: State, gravity: Vector
) -> Vector | None:
    """The force of an effect on object `index`, N, or None where it does not act."""
    if effect.target is not None and effect.target != index:
        return None
    rule = _RULES.get(effect.name)
    return rule(effect, entry, time, state, gravity) if rule else None


def _xyz(values: dict[str, float]) -> Vector:
    return np.array([values["x"], values["y"], values["z"]])


def _drag(effect: Effect, entry: dict[str, Any], time: float, state: State, gravity: Vector) -> Vector:
    speed = float(np.linalg.norm(state.velocity))
    return -(effect.parameters["linear"] + effect.parameters["quadratic"] * speed) * state.velocity


def _magnus(effect: Effect, entry: dict[str, Any], time: float, state: State, gravity: Vector) -> Vector:
    return effect.parameters["coefficient"] * np.cross(state.spin, state.velocity)


def _wind(effect: Effect, entry: dict[str, Any], time: float, state: State, gravity: Vector) -> Vector:
    against = np.array([*effect.hidden["wind"], 0.0]) - state.velocity
    return 0.5 * AIR * SHAPE_DRAG[entry["type"]] * area(entry) * np.linalg.norm(against) * against


def _push(effect: Effect, entry: dict[str, Any], time: float, state: State, gravity: Vector) -> Vector | None:
    begin = effect.parameters["time"]
    return _xyz(effect.parameters) / PUSH_SECONDS if begin <= time + 1e-9 < begin + PUSH_SECONDS else None


def _spring(effect: Effect, entry: dict[str, Any], time: float, state: State, gravity: Vector) -> Vector:
    return effect.parameters["stiffness"] * (_xyz(effect.parameters) - state.position)


def _periodic(effect: Effect, entry: dict[str, Any], time: float, state: State, gravity: Vector) -> Vector:
    return _xyz(effect.parameters) * np.sin(2 * np.pi * effect.parameters["frequency"] * time)


def _growing(effect: Effect, entry: dict[str, Any], time: float, state: State, gravity: Vector) -> Vector:
    return _xyz(effect.parameters) * time**2


def _flip(effect: Effect, entry: dict[str, Any], time: float, state: State, gravity: Vector) -> Vector | None:
    change = effect.parameters["share"] * entry["physics"]["mass"] * -gravity
    return change if time >= effect.parameters["time"] else None


def _vortex(effect: Effect, entry: dict[str, Any], time: float, state: State, gravity: Vector) -> Vector:
    arm = state.position[:2] - [effect.parameters["x"], effect.parameters["y"]]
    around = np.array([-arm[1], arm[0], 0.0]) / (0.2 + arm @ arm)
    return effect.parameters["strength"] * around


_RULES = {
    "drag": _drag,
    "magnus": _magnus,
    "wind": _wind,
    "push": _push,
    "spring": _spring,
    "periodic_force": _periodic,
    "growing_force": _growing,
    "gravity_flip": _flip,
    "vortex": _vortex,
}


def size(effects: tuple[Effect, ...], index: int, time: float) -> float:
    """How large an object is drawn against its primitive."""
    effect = named(effects, "shrinking")
    if effect is None or effect.target != index:
        return 1.0
    return float(np.exp(-effect.parameters["rate"] * time))


def jump(effects: tuple[Effect, ...], index: int, time: float, state: State, body: int, client: int) -> State:
    """Sets an object elsewhere in the step in which it jumps."""
    effect = named(effects, "teleport")
    if effect is None or effect.target != index or round((effect.parameters["time"] - time) * RATE) != 0:
        return state
    place = state.position + _xyz(effect.parameters)
    turn = np.roll(state.quaternion, -1).tolist()
    pybullet.resetBasePositionAndOrientation(body, place.tolist(), turn, physicsClientId=client)
    pybullet.resetBaseVelocity(body, state.velocity.tolist(), state.spin.tolist(), physicsClientId=client)
    return State(place, state.quaternion, state.velocity, state.spin)
