"""What is left of an effect's size once the scene without it has been refitted.

An effect's `px` in the key is counted between the clip with the effect and the clip without, all else equal. But ordinary
numbers of a scene (poses, velocities, sizes, friction, gravity, the camera ...) can take up part of it: a fall with drag
looks like a fall with less gravity. `px_left` is the largest displacement, in pixels, that remains between what is seen with
the effects and the best refit without them: in the exam's own engine, without noise, every number held by a prior as wide
as a clip's rough scene is off (`base.Base`). It is the size of what a perfect fit leaves to be explained.

Displacements are those of the objects' outlines, reach by reach in 16 directions over all frames and objects (shape
(frames, objects, 16), px), with what the effect does to the masks:

- effects of motion, shape and timing: the outlines as they are seen;
- `mask_bias`: all reaches longer by its width, which sizes and camera may take up;
- `occluder`: reaches shorter by what it hides;
- `camera_motion` and `camera_shake`: also the floor's points that show at the start, which the camera moves and no number of
  the scene does (`stage.moved_picture`): these are never explained;
- `camera_roll` and `lens_distortion`: a still background says nothing without a picture of it to compare with, so only the
  objects tell of them. `px`, counted on the floor, may be far more.

A refit lies in the middle: of a jump by 8 px it leaves about 4 on either side, of a bend its sagitta. It minimises squares,
not the largest distance, so that one reach may end farther off than `px`.

It is an upper bound: after bounces more starts find lower ends still, and `costs` tells how far the fits agree.

The fit also sees the flow on each object, so that its spin is not free to take; what is left of the flow is told beside.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.withheld import refit, solve
from benchmarks.withheld.effect import Effect
from benchmarks.withheld.film import Film
from benchmarks.withheld.physics import Engine, engine
from benchmarks.withheld.solve import FAMILIES
from benchmarks.withheld.stage import FRAMES, Stage, moved_picture
from benchmarks.withheld.view import view_of
from mjx_refine.files import write_text

FILE = "left.json"
MOVED = ("camera_motion", "camera_shake")
NOTABLE = 0.5  # widths: shifts of a base's numbers that are told


def clip_of(key: dict[str, Any]) -> tuple[Stage, tuple[Effect, ...]]:
    """A key's scene without effects, and its effects.

    Raises:
      ValueError: an effect does not move the picture by the key's `px` (another engine, or another version).
    """
    stage = Stage(key["truth"], key["kind"])
    effects = []
    for told in key["effects"]:
        target = None if told["target"] is None else key["objects"].index(told["target"])
        effect = Effect(told["effect"], target, told["parameters"], told["hidden"])
        seen = FAMILIES[effect.name].seen
        px = solve.displacement(stage, effect, "objects" if seen == "count" else seen)
        if abs(px - told["px"]) > 0.01 * told["px"] + 0.01:
            raise ValueError(f"{effect.name} moves the picture by {px:.3f} px here; the key says {told['px']}")
        effects.append(effect)
    return stage, tuple(effects)


def background(stage: Stage, effects: tuple[Effect, ...], known: tuple[Effect, ...] = ()) -> float:
    """How far the camera moves the floor's points by those of its effects that are not known, px."""
    film = stage.base
    moving = tuple(e for e in effects if e.name in MOVED and e not in known)
    if not moving:
        return 0.0
    still = tuple(e for e in effects if e not in moving)
    a, b = (Film(film.track, view_of(stage.camera, those, FRAMES), film.solids) for those in (still, effects))
    return moved_picture(a, b)


def left(
    opened: Engine, stage: Stage, effects: tuple[Effect, ...], known: tuple[Effect, ...], rng: np.random.Generator
) -> dict[str, Any]:
    """What is left of the effects that are not known, once the scene with the known ones has been refitted.

    Returns:
      `px_left`; `reach` and `flow`: what is left of outlines and of flow, px (not searched for long where the background's
      motion is more anyway); `background`: px; `cost`: sum of squares in noise
      widths; `costs`: of all fits; `shifts`: of the scene's numbers that moved notably, in widths of their priors.
    """
    model = refit.Refit(opened, stage, effects, known)
    floor = background(stage, effects, known)
    end, costs = refit.best(model, rng, floor)
    return {
        "px_left": round(max(end.reach, floor), 3),
        "reach": round(end.reach, 3),
        "flow": round(end.flow, 3),
        "background": round(floor, 3),
        "cost": round(end.cost, 1),
        "costs": costs,
        "shifts": {
            number.name: round(float(shift), 2)
            for number, shift in zip(model.base.numbers, end.shifts, strict=True)
            if abs(shift) >= NOTABLE
        },
    }


def lefts(
    stage: Stage, effects: tuple[Effect, ...], least: float, rng: np.random.Generator
) -> tuple[float, ...] | None:
    """What is left of each effect [px], the others being known; None as soon as some refit leaves less than `least` of one.

    Without `left`'s starts from the prior, which find less now and then.
    """
    found = []
    with engine() as opened:
        for k, effect in enumerate(effects):
            known = (*effects[:k], *effects[k + 1 :])
            floor = background(stage, (*known, effect), known)
            if floor >= least:  # of what no number of the scene moves nothing is taken up
                found.append(floor)
                continue
            end = refit.best(refit.Refit(opened, stage, effects, known), rng, least, draws=0)[0]
            if max(end.reach, floor) < least:
                return None
            found.append(max(end.reach, floor))
    return tuple(found)


def left_of(path: Path) -> dict[str, Any]:
    """What is left of a clip's effects, together and each by itself, the others being known; or why it cannot be told.

    Of several clips of a set-up, the key and so the result tell of the first.
    """
    begun, key = time.perf_counter(), json.loads(path.read_text())
    try:
        stage, effects = clip_of(key)
    except ValueError as error:
        return {"clip": path.stem, "fault": str(error)}
    rng = np.random.default_rng([*key["seed"], 5])
    with engine() as opened:
        whole = left(opened, stage, effects, (), rng)
        listed = [whole]
        if len(effects) > 1:
            listed = [left(opened, stage, effects, (*effects[:k], *effects[k + 1 :]), rng) for k in range(len(effects))]
    found = [
        {"effect": e.name, "px": told["px"], **one}
        for e, told, one in zip(effects, key["effects"], listed, strict=True)
    ]
    result = {"clip": path.stem, "px_left": whole["px_left"], "effects": found}
    if len(effects) > 1:
        result["together"] = whole
    return {**result, "seconds": round(time.perf_counter() - begun, 1)}


def read(exam: Path) -> dict[str, dict[str, Any]]:
    """What is known so far, by clip; nothing where there is no file."""
    path = exam / FILE
    return json.loads(path.read_text())["clips"] if path.exists() else {}


def measure(exam: Path, jobs: int = 1) -> Iterator[dict[str, Any]]:
    """Measures every clip with effects that has not been yet; yields each as it comes, when it is in the file.

    Raises:
      ValueError: the exam has no key.
    """
    keys = sorted(path for path in (exam / "key").glob("*.json") if path.stem.isdigit())
    if not keys:
        raise ValueError(f"{exam / 'key'} holds no clip's key; make the exam first")
    found = read(exam)
    missing = [p for p in keys if p.stem not in found and json.loads(p.read_text())["effects"]]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for done in as_completed([pool.submit(left_of, path) for path in missing]):
            one = done.result()
            if "fault" not in one:
                found[one["clip"]] = one
                write_text(exam / FILE, json.dumps({"clips": dict(sorted(found.items()))}, indent=1) + "\n")
            yield one
