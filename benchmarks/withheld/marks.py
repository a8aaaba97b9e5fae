"""One answer against its key."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.withheld.stage import FRAMES

VECTORS: dict[str, dict[str, tuple[str, ...]]] = {
    # Shares of the true magnitude.
    "magnus": {"coefficient": ("coefficient",)},
    "wind": {"pressure": ("x", "y")},
    "push": {"impulse": ("x", "y", "z")},
    "slope": {"tilt": ("x", "y")},
    "friction_patch": {"friction": ("friction",)},
    "offset_com": {"offset": ("x", "y", "z")},
    "camera_shake": {"amplitude": ("amplitude",)},
    "camera_roll": {"angle": ("angle",)},
    "lens_distortion": {"k1": ("k1",)},
    "rolling_shutter": {"readout": ("readout",)},
    "mask_bias": {"width": ("width",)},
}
APART: dict[str, dict[str, tuple[str, ...]]] = {
    # In the parameter's own unit.
    "push": {"time [s]": ("time",)},
    "friction_patch": {"centre [m]": ("x", "y"), "radius [m]": ("radius",)},
    "hidden_obstacle": {"distance [m]": ("distance",)},
    "camera_motion": {"turn [deg/s]": ("pan", "tilt"), "travel [m/s]": ("x", "y", "z")},
    "dropped_frames": {"frame": ("frame",), "count": ("count",)},
    "occluder": {"edges [px]": ("left", "top", "right", "bottom")},
}
LOCATED = ("push", "hidden_obstacle", "friction_patch", "dropped_frames")
SLACK = 2  # frames by which features smear a moment on either side
LEAST_IOU = 0.3


@dataclass(frozen=True)
class Mark:
    """What one answer was worth.

    Fields:
      clip, split, truth (names), said (the verdict's names), probability: as they stand.
      right: exactly the right verdict. first: the right name stands first. near: it stands among the first two, or the
        verdict declares it indistinguishable from its own first. object_right, frames_right, since_right: of the place,
        None where no place is asked for; `since` counts all frames from the first on.
      closed: of the gap, None where the file has none. errors: of the parameters by "effect: parameter".
      px: largest displacement. lefts: what is left of each effect once the scene has been refitted, px (of `left.py`, or
        the key); empty where it has not been measured. rank: place of the right name among the candidates, from 1, None
        where it is not there or there is not one right name. flow, kind: of the clip. seconds, peak_mb: of the diagnosis.
    """

    clip: str
    split: str
    truth: tuple[str, ...]
    said: tuple[str, ...]
    probability: float
    right: bool
    first: bool
    near: bool
    object_right: bool | None
    frames_right: bool | None
    since_right: bool | None
    closed: float | None
    px: float | None
    flow: str
    kind: str
    seconds: float
    peak_mb: float
    errors: dict[str, float] = field(default_factory=dict)
    lefts: tuple[float, ...] = ()
    rank: int | None = None

    @property
    def px_left(self) -> float | None:
        """What is left of the least of its effects, px; None where it has not been measured."""
        return min(self.lefts) if self.lefts else None


def mark(
    clip: str, key: dict[str, Any], diagnosis: dict[str, Any], ran: dict[str, Any], left: dict[str, Any] | None = None
) -> Mark:
    """Compares an answer with its key; `left`: what has been measured by `left.py`, if it has.

    Raises:
      KeyError: the diagnosis lacks something that its format demands.
    """
    verdict = diagnosis["verdict"]
    said = tuple(verdict["effects"])
    truth = tuple(effect["effect"] for effect in key["effects"])
    split = key["split"]
    wanted = _wanted(split, truth, tuple(key["accepts"]))
    candidates = [c["effect"] for c in diagnosis["candidates"]]
    first = _first(said) in {names[0] if names else None for names in wanted}
    if split == "two":
        first = bool(said) and said[0] in truth
    place = _place(key, diagnosis["where"]) if split == "one" else (None, None, None)
    closed = diagnosis["gap"].get("closed")
    sizes = [effect["px"] for effect in key["effects"]]
    return Mark(
        clip=clip,
        split=split,
        truth=truth,
        said=said,
        probability=float(verdict["probability"]),
        right=any(sorted(said) == sorted(names) for names in wanted),
        first=first,
        near=first or (split == "one" and _near(truth[0], said, candidates, verdict["indistinguishable"])),
        object_right=place[0],
        frames_right=place[1],
        since_right=place[2],
        closed=None if closed is None or not math.isfinite(closed) else float(closed),
        px=max(sizes) if sizes else None,
        flow=key["flow"],
        kind=key["kind"],
        seconds=float(ran["seconds"]),
        peak_mb=float(ran["peak_mb"]),
        errors=_errors(key, diagnosis, said) if split in ("one", "two") else {},
        lefts=_lefts(left["effects"] if left else key["effects"]),
        rank=candidates.index(truth[0]) + 1 if split == "one" and truth[0] in candidates else None,
    )


def _lefts(effects: list[dict[str, Any]]) -> tuple[float, ...]:
    """What is left of each effect; empty where it was not measured."""
    told = [effect.get("px_left") for effect in effects]
    return tuple(float(px) for px in told if px is not None)


def _wanted(split: str, truth: tuple[str, ...], accepts: tuple[str, ...]) -> list[tuple[str, ...]]:
    if split in ("withheld", "strange"):
        return [("unknown",), *((name,) for name in accepts if split == "strange")]
    return [truth]


def _first(said: tuple[str, ...]) -> str | None:
    return said[0] if said else None


def _near(name: str, said: tuple[str, ...], candidates: list[str], groups: list[list[str]]) -> bool:
    declared = any(name in group and _first(said) in group for group in groups)
    return name in said[:2] or name in candidates[:2] or declared


def overlap(a: Sequence[int], b: Sequence[int]) -> float:
    """Intersection over union of two windows of frames, both ends counted in."""
    both = min(a[1], b[1]) - max(a[0], b[0]) + 1
    return max(both, 0) / ((a[1] - a[0] + 1) + (b[1] - b[0] + 1) - max(both, 0))


def _place(key: dict[str, Any], where: list[dict[str, Any]]) -> tuple[bool | None, bool | None, bool | None]:
    effect = key["effects"][0]
    if effect["effect"] not in LOCATED:
        return None, None, None
    if not where:
        return False, False, False
    top = where[0]
    first, last = effect["acts"]
    end = FRAMES - 1
    acts = (max(first - SLACK, 0), min(last + SLACK, end))
    right = effect["object"] is None or top["object"] == effect["object"]
    frames = tuple(int(v) for v in top["frames"])
    return right, overlap(frames, acts) > LEAST_IOU, overlap(frames, (first, end)) > LEAST_IOU


def _errors(key: dict[str, Any], diagnosis: dict[str, Any], said: tuple[str, ...]) -> dict[str, float]:
    """Errors of the parameters of effects that the verdict names rightly."""
    out: dict[str, float] = {}
    for effect in key["effects"]:
        name, true = effect["effect"], effect["parameters"]
        found = next((c for c in diagnosis["candidates"] if c["effect"] == name), None)
        if name not in said or found is None:
            continue
        values = {k: v["value"] for k, v in found["parameters"].items()}
        for title, keys in VECTORS.get(name, {}).items():
            if all(k in values for k in keys):
                size = math.hypot(*(true[k] for k in keys))
                out[f"{name}: {title}"] = _distance(true, values, keys) / size
        for title, keys in APART.get(name, {}).items():
            if all(k in values for k in keys):
                out[f"{name}: {title}"] = _distance(true, values, keys)
        if name == "drag":
            # Linear and quadratic trade with each other: what counts is the force at the clip's speed.
            force = [_drag(v, effect["speed"]) for v in (true, values)]
            out["drag: force at the clip's speed"] = abs(force[1] / force[0] - 1)
        if name == "hidden_obstacle" and "angle" in values:
            out["hidden_obstacle: angle [deg]"] = abs((values["angle"] - true["angle"] + 180) % 360 - 180)
    return out


def _drag(values: dict[str, float], speed: float) -> float:
    return values.get("linear", 0.0) + values.get("quadratic", 0.0) * speed


def _distance(true: dict[str, float], values: dict[str, float], keys: tuple[str, ...]) -> float:
    return math.hypot(*(true[k] - values[k] for k in keys))
