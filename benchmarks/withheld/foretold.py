"""What a diagnosis predicts with an exam's own numbers, against the exam's pictures: whether effects mean the same to both.

The exam has effects implemented anew. Where a prediction with the key's scene, effects included, is off before contacts have
done much, no search finds what the exam has, and something else explains the clip better.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.withheld.answer import clips
from mjx_refine.diagnosis.seen.measure import measure
from mjx_refine.diagnosis.seen.predict import Predictor
from mjx_refine.effects import batch_with_effects, catalogue
from mjx_refine.effects.acting import on_the_floor
from mjx_refine.observation import load_observation
from mjx_refine.scene import Scene
from mjx_refine.scene.read import scene_from_entries
from mjx_refine.sim.c import MujocoSimulator

FIRST = 5
"""Frames that are looked at: no two engines agree for long on what contacts do."""


@dataclass(frozen=True)
class Foretold:
    """Errors of a prediction with one clip's own numbers, medians over objects and frames.

    Fields:
      clip, effects: as they stand. centroid, radius: of masks that are seen whole, px. flow: px/frame. worst: of centroids, px.
    """

    clip: str
    effects: tuple[str, ...]
    centroid: float
    radius: float
    flow: float
    worst: float


def entries(key: dict[str, Any]) -> list[dict[str, Any]]:
    """The key's scene with its effects as a scene file has them."""
    found = []
    for effect in key["effects"]:
        known = {parameter.name for parameter in catalogue()[effect["effect"]].parameters}
        parameters = {name: value for name, value in effect["parameters"].items() if name in known}
        if effect["effect"] == "wind":
            parameters["slowness"] = 1.0 / float(np.linalg.norm(effect["hidden"]["wind"]))
        entry = {"type": "effect", "effect": effect["effect"], "parameters": parameters}
        found.append(entry if effect["target"] is None else {**entry, "target": effect["target"]})
    return [*key["truth"], *found]


def foretold(folder: Path) -> Iterator[Foretold]:
    """Every clip's, but for those whose effects no catalogue has or whose numbers mean nothing to it (`shape`)."""
    for path in clips(folder):
        key = json.loads((folder / "key" / f"{path.name}.json").read_text())
        if {effect["effect"] for effect in key["effects"]} <= set(catalogue()) - {"shape"}:
            yield _foretold(path, key, scene_from_entries(entries(key), f"key {path.name}"))


def _foretold(path: Path, key: dict[str, Any], scene: Scene) -> Foretold:
    seen = load_observation(path / "flows.npz")
    ids = [] if seen.masks is None else [int(i) for i in np.unique(seen.masks) if i]
    measured = measure(seen, tuple(ids.index(i) if i in ids else -1 for i in key["mask_ids"]))
    # The exam's objects stand on its tilted floor as the key's do on a level one.
    batch = on_the_floor(batch_with_effects([scene]))
    poses = MujocoSimulator(scene.shapes, seen.fps, 1).rollout(batch, seen.length)
    told = Predictor.of(measured, scene.shapes, seen.size, seen.fps)(poses, batch)
    moments = (measured.moments - told.moments[0])[:FIRST]
    flow = (measured.flow - told.flow[0])[:FIRST]
    off = np.linalg.norm(moments[..., :2], axis=-1)
    return Foretold(
        path.name,
        tuple(effect["effect"] for effect in key["effects"]),
        _median(off),
        _median(np.abs(moments[..., 2])),
        _median(np.linalg.norm(flow, axis=-1)),
        float(np.nanmax(off, initial=-np.inf)) if np.isfinite(off).any() else float("nan"),
    )


def _median(values: np.ndarray) -> float:
    return float(np.nanmedian(values)) if np.isfinite(values).any() else float("nan")
