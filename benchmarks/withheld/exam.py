"""One clip of the exam, and the whole of it."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from benchmarks.clips.writing import scene_text
from benchmarks.withheld import left, masks, several, solve, start
from benchmarks.withheld.effect import Effect, named
from benchmarks.withheld.film import Film, measured_flow, paint, picture
from benchmarks.withheld.solve import FAMILIES, Solved
from benchmarks.withheld.stage import FRAMES, MOVING, Stage, film_fault
from benchmarks.withheld.track import RATE
from benchmarks.withheld.view import FPS
from mjx_refine.files import write_atomic, write_text

NOISE = 0.2  # px, of the exact flow
QUANTUM = 16  # flow is written in sixteenths of a pixel: finer than its noise, and it packs well
ATTEMPTS = 600


@dataclass(frozen=True)
class Order:
    """What a clip is to hold: its split, effects, flow (`exact` or `dis`), seed, how many clips of the set-up, and how much of
    each effect a refit of the scene without it must leave [px] (`left.left`)."""

    split: str
    effects: tuple[str, ...]
    flow: str
    seed: tuple[int, int]
    clips: int = 1
    left: float = 0.0


@dataclass(frozen=True)
class Take:
    """A clip that passed every filter; lefts: what a refit leaves of each effect [px], where that was asked for."""

    stage: Stage
    film: Film
    solved: tuple[Solved, ...]
    lefts: tuple[float, ...] = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects at work."""
        return tuple(s.effect for s in self.solved)


def find(order: Order) -> tuple[Take, np.random.Generator]:
    """Draws scenes and effects until a clip passes; the generator goes on from there.

    Raises:
      ValueError: none did (the message counts the reasons).
    """
    rng = np.random.default_rng(order.seed)
    reasons: dict[str, int] = {}
    for attempt in range(ATTEMPTS):
        stage = start.draw_stage(rng, order.effects)
        found = _attempt(rng, stage, order.effects)
        if isinstance(found, Take) and order.left:
            # A generator of its own: the clip is the one that would be drawn anyway.
            found = _leaving(found, order.left, np.random.default_rng([*order.seed, 5, attempt]))
        if isinstance(found, Take):
            return found, rng
        reasons[found] = reasons.get(found, 0) + 1
    raise ValueError(f"no clip for {order} in {ATTEMPTS} attempts: {reasons}")


def _attempt(rng: np.random.Generator, stage: Stage, names: tuple[str, ...]) -> Take | str:
    reason = stage.fault() or film_fault(stage.base, stage.entries)
    if reason is not None:
        return reason
    solved = []
    for name in names:
        low, high = FAMILIES[name].pixels
        target = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        one = solve.solve(rng, stage, name, target)
        if one is None:
            return f"{name} does not reach its size"
        solved.append(one)
    film = stage.film(tuple(s.effect for s in solved))
    reason = film_fault(film, stage.entries)
    if reason is not None:
        return reason
    if film.track.wall is not None:
        solved = [solve.with_wall(s, film.track.wall) if s.effect.name == "hidden_obstacle" else s for s in solved]
    take = Take(stage, film, tuple(solved))
    idle = [name for k, name in enumerate(names) if not _acts(take, k)]
    return f"{idle[0]} hardly acts" if idle else take


def _leaving(take: Take, least: float, rng: np.random.Generator) -> Take | str:
    """The take with what a refit leaves of each of its effects, or why that is not enough."""
    lefts = left.lefts(take.stage, take.effects, least, rng)
    return replace(take, lefts=lefts) if lefts is not None else "a refit leaves too little"


def window(take: Take, index: int) -> tuple[int, int] | None:
    """First and last frame in which an effect acts, or None where it never does."""
    effect, film = take.effects[index], take.film
    if effect.name == "dropped_frames":
        first, count = effect.parameters["frame"], effect.parameters["count"]
        return first - 1, first if count > 0 else min(first - 1 - count, FRAMES - 1)
    if effect.name == "occluder":
        frames = masks.hidden_frames(film, effect)
        return (frames[0], frames[-1]) if frames else None
    if effect.name in ("push", "hidden_obstacle", "friction_patch"):
        target = 0 if effect.target is None else effect.target
        steps = np.nonzero(film.track.acting[index, :, target])[0]
        steps = steps[steps < (FRAMES - 1) * RATE / FPS]
        if not len(steps):
            return None
        return int(steps[0] * FPS // RATE), min(int(np.ceil((steps[-1] + 1) * FPS / RATE)), FRAMES - 1)
    return 0, FRAMES - 1


def _acts(take: Take, index: int) -> bool:
    effect, span = take.effects[index], window(take, index)
    if span is None:
        return False
    if effect.name in ("push", "hidden_obstacle"):
        return 3 <= span[0] <= FRAMES - 7
    if effect.name in ("friction_patch", "occluder"):  # it must come or go while there is something to see
        return span[1] - span[0] >= 3 and (span[0] >= 4 or span[1] <= FRAMES - 6)
    if effect.name == "mask_bias":  # something of a thinned mask must be left
        reach = take.film.outlines
        width = effect.parameters["width"]
        return width > 0 or float((reach + np.roll(reach, 8, -1)).min()) > -4 * width
    if effect.name in ("camera_roll", "lens_distortion"):  # a still background does not tell of them; objects must
        return solve.displacement(take.stage, effect, "objects") > 1.5
    return True


def seen_ids(take: Take) -> list[UInt8[np.ndarray, "height width"]]:
    """Ids of every frame as they are measured but for noise: 0 background, i + 1 object i."""
    bias = named(take.effects, "mask_bias")
    film = take.film
    if bias is not None:
        ids = [masks.widened(film, k, bias.parameters["width"]) for k in range(film.frames)]
    else:
        ids = [film.cast(k).ids for k in range(film.frames)]
    return [i.astype(np.uint8) for i in ids]


def exact_flow(take: Take) -> Float[np.ndarray, "steps height width 2"]:
    """Flow of what is seen, without noise."""
    film = take.film
    return np.stack([film.flow(k, film.cast(k)) for k in range(film.frames - 1)])


def pictures(take: Take, rng: np.random.Generator) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Rendered frames, with whatever stands before the objects."""
    look = paint(rng, len(take.film.solids))
    frames = [picture(take.film, k, look, rng) for k in range(take.film.frames)]
    blind = named(take.effects, "occluder")
    if blind is not None:
        part = masks.rectangle(blind.parameters)
        cover = look.ground[part[0], part[1]][:, ::-1] // 2 + 40
        for frame in frames:
            frame[part] = cover
    return frames


def observe(take: Take, flow_kind: str, rng: np.random.Generator) -> dict[str, Any]:
    """The arrays of `flows.npz`, and `mask_ids`: each object's id in them."""
    count = len(take.film.solids)
    names = rng.permutation(count) + 1
    lookup = np.concatenate([[0], names]).astype(np.uint8)
    ids = [masks.noisy(lookup[i], rng) for i in seen_ids(take)]
    blind = named(take.effects, "occluder")
    if flow_kind == "dis":
        flow = measured_flow(pictures(take, rng))
    else:
        flow = exact_flow(take)
        if blind is not None:
            flow[:, *masks.rectangle(blind.parameters)] = 0
        flow = flow + rng.normal(0, NOISE, flow.shape)
    if blind is not None:
        for image in ids:
            image[masks.rectangle(blind.parameters)] = 0
    arrays: dict[str, Any] = {
        "flow": (np.round(flow * QUANTUM) / QUANTUM).astype(np.float16),
        "masks": np.stack(ids),
        "fps": np.float64(FPS),
    }
    if flow_kind == "exact":
        arrays["flow_sigma"] = np.float64(NOISE)
    return {"arrays": arrays, "mask_ids": names.tolist()}


def key(order: Order, take: Take, mask_ids: list[int]) -> dict[str, Any]:
    """What an examiner knows of a clip."""
    names = [e["name"] for e in take.stage.objects]
    effects = []
    for index, solved in enumerate(take.solved):
        effect, span = solved.effect, window(take, index)
        speed = float(np.sqrt((take.film.track.speed[: int((FRAMES - 1) * RATE / FPS), 0] ** 2).mean()))
        effects.append(
            {
                "effect": effect.name,
                "target": None if effect.target is None else names[effect.target],
                "parameters": effect.parameters,
                "hidden": effect.hidden,
                "px": round(solved.px, 3),
                "px_target": round(solved.target, 3),
                "px_left": round(take.lefts[index], 3) if take.lefts else None,
                "px_objects": round(solve.displacement(take.stage, effect, "objects"), 3)
                if FAMILIES[effect.name].seen in ("objects", "picture")
                else None,
                "acts": list(span or ()),
                "object": names[effect.target or 0] if effect.name in MOVING | {"shape"} else None,
                "speed": round(speed, 4),
            }
        )
    return {
        "split": order.split,
        "effects": effects,
        "accepts": sorted({name for e in order.effects for name in FAMILIES[e].accepts}),
        "flow": order.flow,
        "kind": take.stage.kind,
        "objects": names,
        "mask_ids": mask_ids,
        "seed": list(order.seed),
        "truth": take.stage.entries,
    }


def _pack(stream: BinaryIO, arrays: dict[str, Any]) -> None:
    """`np.savez_compressed` at zlib's quickest level: noise packs no better at the others."""
    with zipfile.ZipFile(stream, "w") as archive:
        for name, array in arrays.items():
            part = io.BytesIO()
            np.lib.format.write_array(part, np.asanyarray(array), allow_pickle=False)
            # A ZipInfo has a fixed date, so that the same clip is the same file.
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), part.getvalue(), zipfile.ZIP_DEFLATED, 1)


def others(take: Take, count: int, rng: np.random.Generator) -> list[Take]:
    """More clips of a take's set-up.

    Raises:
      ValueError: none passed the filters (the message counts the reasons).
    """
    found: list[Take] = []
    reasons: dict[str, int] = {}
    for _ in range(several.ATTEMPTS):
        if len(found) == count:
            return found
        told = several.another(rng, take.stage, take.solved)
        if not isinstance(told, str):
            stage, solved = told
            film = stage.film(tuple(s.effect for s in solved))
            one = Take(stage, film, solved)
            idle = [s.effect.name for k, s in enumerate(solved) if not _acts(one, k)]
            told = film_fault(film, stage.entries) or (f"{idle[0]} hardly acts" if idle else "")
            if not told:
                found.append(one)
                continue
        reasons[told] = reasons.get(told, 0) + 1
    raise ValueError(f"no {count} more clips in {several.ATTEMPTS} attempts: {reasons}")


def find_set_up(order: Order) -> tuple[Take, list[Take], np.random.Generator]:
    """A clip and the others of its set-up; set-ups that allow no others are drawn again.

    Raises:
      ValueError: none did.
    """
    if order.clips == 1:
        take, rng = find(order)
        return take, [], rng
    for again in range(8):
        take, rng = find(replace(order, seed=(order.seed[0] + 1000 * again, order.seed[1])))
        try:
            return take, others(take, order.clips - 1, rng), rng
        except ValueError:
            continue
    raise ValueError(f"no set-up of {order.clips} clips for {order}")


def write_clip(out: Path, number: int, order: Order) -> str:
    """Makes a clip and writes its folder and key (last); returns a line about it."""
    cv2.setNumThreads(1)
    take, more, rng = find_set_up(order)
    seen = observe(take, order.flow, rng)
    folder, name = out / "clips" / f"{number:03d}", f"{number:03d}.json"
    folder.mkdir(parents=True, exist_ok=True)
    (out / "key").mkdir(exist_ok=True)
    write_atomic(folder / "flows.npz", lambda stream: _pack(stream, seen["arrays"]))
    write_text(folder / "init.yaml", scene_text(start.rough(take.stage.entries, rng)))
    for k, one in enumerate(more, 2):
        arrays = observe(one, order.flow, rng)["arrays"]
        write_atomic(folder / f"flows_{k}.npz", lambda stream, arrays=arrays: _pack(stream, arrays))
        write_text(folder / f"init_{k}.yaml", scene_text(start.rough(one.stage.entries, rng)))
    withheld = order.effects if order.split == "withheld" else ()
    write_text(folder / "without.txt", "".join(f"{e}\n" for e in withheld))
    write_text(out / "key" / name, json.dumps(key(order, take, seen["mask_ids"]), indent=1) + "\n")
    sizes = ", ".join(f"{s.effect.name} {s.px:.1f} px" for s in take.solved) or "nothing"
    also = "".join("; " + ", ".join(f"{s.px:.1f} px" for s in one.solved) for one in more)
    return f"{number:03d}: {take.stage.kind}, {len(take.film.solids)} objects, {order.flow}, {sizes}{also}"
