"""More clips of one set-up: the same objects, camera and effects, other initial states."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from benchmarks.clips import rotation
from benchmarks.clips.bullet import Entry, bodies
from benchmarks.withheld import solve
from benchmarks.withheld.families import ALL, CATALOGUE
from benchmarks.withheld.solve import FAMILIES, Solved
from benchmarks.withheld.stage import Stage, film_fault, resting

PASSING = ("push", "dropped_frames", "camera_shake")
"""Effects that happen once, and belong to a clip rather than to a set-up."""

LASTING = tuple(name for name in CATALOGUE if name not in PASSING)

ATTEMPTS = 400
LEAST = 0.3  # of the first clip's displacement that the effect must have in the others


def another(
    rng: np.random.Generator, stage: Stage, solved: tuple[Solved, ...]
) -> tuple[Stage, tuple[Solved, ...]] | str:
    """One more clip's stage with the same effects and what they do to it, or why it is of no use."""
    kinds = set(ALL)
    for one in solved:
        kinds &= set(FAMILIES[one.effect.name].kinds)
    other = Stage([_elsewhere(entry, rng) for entry in stage.entries], stage.kind if stage.kind in kinds else "flight")
    reason = other.fault() or film_fault(other.base, other.entries)
    if reason is not None:
        return reason
    again = []
    for one in solved:
        seen = FAMILIES[one.effect.name].seen
        px = solve.displacement(other, one.effect, "objects" if seen == "count" else seen)
        if px < LEAST * one.px:
            return f"{one.effect.name} hardly acts"
        again.append(replace(one, px=px))
    return other, tuple(again)


def _elsewhere(entry: Entry, rng: np.random.Generator) -> Entry:
    """An object somewhere near, with another heading, speed and spin; camera and gravity as they are."""
    if not bodies([entry]):
        return entry
    result = copy.deepcopy(entry)
    state = result["state"]
    on_floor = resting(entry)
    yaw = rotation.about(np.array([0.0, 0.0, 1.0]), float(rng.normal(0, 0.5)))
    state["orientation"] = rotation.product(yaw, np.array(state["orientation"], float)).tolist()
    turn, factor = rotation.matrix(yaw), float(np.exp(rng.normal(0, 0.25)))
    velocity = factor * turn @ np.array(state["linear_velocity"], float)
    state["linear_velocity"] = velocity.tolist()
    # Turned with the body, the spin's numbers in its frame only grow or shrink.
    state["angular_velocity"] = (factor * np.array(state["angular_velocity"], float)).tolist()
    place = np.array(state["position"], float)
    place[:2] += rng.normal(0, 0.25, 2)
    if not on_floor:
        least = rotation.half_height(result, np.array(state["orientation"], float))
        place[2] = max(place[2] * float(np.exp(rng.normal(0, 0.2))), least + 0.02)
    state["position"] = place.tolist()
    return result
