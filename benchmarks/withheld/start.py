"""Base scenes that suit an effect, and the scene file a diagnosis starts from."""

from __future__ import annotations

import copy

import numpy as np
from jaxtyping import Float

from benchmarks.clips import rotation
from benchmarks.clips.bullet import Entry, bodies
from benchmarks.clips.scenes import draw_scene
from benchmarks.withheld.families import ALL, CATALOGUE, STRANGE
from benchmarks.withheld.stage import SIZE, Stage, resting

UP = np.array([0.0, 0.0, 1.0])


def draw_stage(rng: np.random.Generator, effects: tuple[str, ...]) -> Stage:
    """A random scene whose motion suits all the effects; it may still be of no use."""
    families = [CATALOGUE.get(name) or STRANGE[name] for name in effects]
    kinds = [kind for kind in ALL if all(kind in family.kinds for family in families)]
    kind = str(rng.choice(kinds or ["flight"]))
    count = int(rng.choice([1, 2, 3], p=[0.5, 0.38, 0.12]))
    entries = draw_scene(rng, kind, max(count, 2) if kind == "collision" else count, SIZE)
    first = bodies(entries)[0]
    state = first["state"]
    if kind == "flight" and {"magnus", "offset_com"} & set(effects):
        spin = rng.normal(size=3)
        state["angular_velocity"] = (spin / np.linalg.norm(spin) * rng.uniform(5, 14)).tolist()
    if "wind" in effects:  # heavy, so that the wind is fast against the bodies
        for entry in bodies(entries):
            entry["physics"]["mass"] *= float(np.exp(rng.uniform(0, np.log(15))))
    return Stage(entries, kind)


def rough(truth: list[Entry], rng: np.random.Generator) -> list[Entry]:
    """The scene as a refinement might have left it: every continuous number but the mass somewhat off."""
    scene = copy.deepcopy(truth)
    camera = next(e for e in scene if e["type"] == "camera")
    camera["orientation"] += float(rng.normal(0, 0.7))
    camera["fovy"] += float(rng.normal(0, 1.0))
    camera["position"][2] += float(rng.normal(0, 0.03))
    pull = next(e for e in scene if e["type"] == "gravity")
    pull["gravity"] = (np.array(pull["gravity"]) * (1 + rng.normal(0, 0.03))).tolist()
    for entry in bodies(scene):
        _rough_body(entry, rng)
    return scene


def _rough_body(entry: Entry, rng: np.random.Generator) -> None:
    state, physics = entry["state"], entry["physics"]
    on_floor = resting(entry)
    for key in ("radius", "height"):
        if key in entry:
            entry[key] = float(entry[key] * (1 + rng.normal(0, 0.03)))
    if "size" in entry:
        entry["size"] = (np.array(entry["size"]) * (1 + rng.normal(0, 0.03, 3))).tolist()
    axis = UP if on_floor else _unit(rng)
    turn = rotation.about(axis, float(rng.normal(0, np.radians(2))))
    quaternion = rotation.product(turn, np.array(state["orientation"], float))
    state["orientation"] = quaternion.tolist()
    place = np.array(state["position"]) + rng.normal(0, 0.03, 3)
    height = rotation.half_height(entry, quaternion)
    place[2] = height if on_floor else max(place[2], height + 0.005)
    state["position"] = place.tolist()
    for key, share in (("linear_velocity", 0.06), ("angular_velocity", 0.1)):
        value = np.array(state[key], float)
        error = rng.normal(0, share, 3) * np.linalg.norm(value)
        if on_floor and key == "linear_velocity":
            error[2] = 0
        if on_floor and key == "angular_velocity":  # only along what turns already: no new tilt
            error = np.where(np.abs(value) > 1e-9, error, 0)
        state[key] = (value + error).tolist()
    physics["friction"] = (np.array(physics["friction"]) * np.exp(rng.normal(0, 0.2, 2))).tolist()
    physics["damping"] = float(physics["damping"] * np.exp(rng.normal(0, 0.4)))


def _unit(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)
