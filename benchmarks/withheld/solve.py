"""How strong an effect must be to move the picture by so many pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.withheld import masks
from benchmarks.withheld.effect import Effect
from benchmarks.withheld.families import CATALOGUE, STRANGE, Family, Rule
from benchmarks.withheld.stage import Stage, moved_objects, moved_picture

TOLERANCE = 0.12
FAMILIES: dict[str, Family] = {**CATALOGUE, **STRANGE}


@dataclass(frozen=True)
class Solved:
    """An effect and what it does to the picture alone: px, displacement in the family's measure; target: what was aimed at."""

    effect: Effect
    px: float
    target: float


def displacement(stage: Stage, effect: Effect, seen: str) -> float:
    """How far an effect alone moves the picture of a scene, pixels (see `Family.seen`)."""
    if seen == "width":
        return abs(effect.parameters["width"])
    if seen == "hidden":
        return masks.bitten(stage.base, effect)
    film = stage.film((effect,))
    return (moved_picture if seen == "picture" else moved_objects)(stage.base, film)


def solve(rng: np.random.Generator, stage: Stage, name: str, target: float) -> Solved | None:
    """Draws an effect and sets its strength by bisection; None where the scene or the range does not allow it."""
    family = FAMILIES[name]
    rule = family.draw(rng, stage)
    if rule is None:
        return None
    if family.seen == "count":
        return _counted(stage, rule, family, target)

    def measure(strength: float) -> float:
        effect = rule(strength)
        return -1.0 if effect is None else displacement(stage, effect, family.seen)

    low, high = family.span
    strength = _reach(measure, low, high, target)
    if strength is None:
        return None
    effect = rule(strength)
    if effect is None:
        return None
    px = displacement(stage, effect, family.seen)
    return Solved(effect, px, target) if abs(px / target - 1) < TOLERANCE else None


def _reach(measure: Callable[[float], float], low: float, high: float, target: float) -> float | None:
    """The first strength, from weak to strong, that moves by `target`; bisected in its logarithm."""
    ladder = np.geomspace(low, high, 8)
    below = None
    for strength in ladder:
        px = measure(float(strength))
        if 0 <= px < target:
            below = strength
        elif px >= target:
            if below is None:
                return float(strength) if px < target * (1 + TOLERANCE) else None
            break
    else:
        return None
    above = strength
    for _ in range(9):
        middle = float(np.sqrt(below * above))
        px = measure(middle)
        if abs(px / target - 1) < 0.03:
            return middle
        below, above = (middle, above) if px < target else (below, middle)
    return float(above)


def _counted(stage: Stage, rule: Rule, family: Family, target: float) -> Solved | None:
    """The whole number that comes nearest to the target."""
    best = None
    for strength in np.arange(family.span[0], family.span[1] + 1):
        effect = rule(float(strength))
        if effect is None:
            continue
        px = displacement(stage, effect, "objects")
        if family.pixels[0] <= px <= family.pixels[1]:
            found = Solved(effect, px, target)
            if best is None or abs(np.log(px / target)) < abs(np.log(best.px / target)):
                best = found
    return best


def with_wall(solved: Solved, wall: tuple[float, float]) -> Solved:
    """The hidden obstacle's parameters as they were read off the first hit."""
    angle, distance = wall
    return replace(solved, effect=replace(solved.effect, parameters={"angle": angle, "distance": distance}))
