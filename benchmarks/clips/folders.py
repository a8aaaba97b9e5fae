"""Clip folders on disk: `flows.npz`, `best32.yaml`, `truth.yaml`, `meta.json`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import reference, samples
from benchmarks.clips.clip import Clip, make_clip
from benchmarks.clips.samples import SampleSet, rough_samples
from benchmarks.clips.scenes import KINDS
from benchmarks.clips.writing import samples_text, scene_text
from mjx_refine.files import write_atomic, write_text

ALONE = ("flight", "slide", "roll", "bounce", "topple", "slide")  # a single object cannot collide


def plan(count: int) -> list[tuple[str, int]]:
    """(kind, number of objects) of each clip: 1, 2, 3, 4 objects in turn; 24 clips hold every kind at each number."""
    out = []
    for index in range(count):
        objects, turn = index % 4 + 1, (index // 4 + index % 4 * 5) % 6
        out.append((ALONE[turn] if objects == 1 else KINDS[turn], objects))
    return out


def film(seed: int, kind: str, objects: int, **options: Any) -> tuple[Clip, SampleSet]:
    """A clip and samples for it; a clip for which no samples of the wanted quality are found is replaced.

    Raises:
      ValueError: ten clips in a row failed.
    """
    for again in range(10):
        clip = make_clip(seed + 1_000_000 * again, kind, objects, **options)
        try:
            return clip, rough_samples(clip.truth, clip.masks, seed, fps=clip.fps)
        except ValueError as error:
            last = error
    raise ValueError(f"seed {seed}, {kind}, {objects} objects: {last}")


def flow_error(clip: Clip, stride: int = 4) -> tuple[list[float], list[float]]:
    """Median and mean end-point error of the measured flow against the exact one inside each object's mask, pixels."""
    size = (clip.masks.shape[2], clip.masks.shape[1])
    poses = np.concatenate([clip.position, clip.quaternion], -1)
    part = (slice(None), slice(stride // 2, None, stride), slice(stride // 2, None, stride))
    exact = reference.exact_flow(clip.truth, poses, size, stride)
    error = np.linalg.norm(exact - clip.flow[part].astype(float), axis=-1)
    inside = [error[clip.masks[:-1][part] == i] for i in clip.mask_ids]
    return [float(np.median(e)) for e in inside], [float(e.mean()) for e in inside]


def write_clip(
    folder: Path, clip: Clip, guesses: SampleSet, *, broken: int = 0, extra: dict[str, Any] | None = None
) -> None:
    """Writes a clip's folder; `meta.json` comes last, so a folder that has it is whole."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {"flow": clip.flow, "masks": clip.masks, "fps": np.float64(clip.fps), "frames": clip.frames}
    write_atomic(folder / "flows.npz", lambda stream: np.savez_compressed(stream, **arrays))
    text = samples_text(guesses.scenes, tagged=clip.seed % 2 == 0, broken=broken, seed=clip.seed)
    write_text(folder / "best32.yaml", text)
    write_text(folder / "truth.yaml", scene_text(clip.truth))
    again = samples.sample_iou(clip.truth, clip.masks, fps=clip.fps)
    error = flow_error(clip)
    meta = {
        "kind": clip.kind,
        "objects": len(clip.mask_ids),
        "seed": clip.seed,
        "mask_ids": list(clip.mask_ids),
        "truth_iou_in_mujoco": round(float(again.mean()), 4),
        "flow_error_px": {"median": [round(v, 3) for v in error[0]], "mean": [round(v, 3) for v in error[1]]},
        "sample_iou": {
            "mean": round(float(guesses.iou.mean()), 4),
            "best": round(float(guesses.iou.max()), 4),
            "best_index": int(guesses.iou.argmax()),
            "each": [round(float(v), 4) for v in guesses.iou],
            "first_frame": [round(float(v), 4) for v in guesses.first_iou],
        },
        **(extra or {}),
    }
    write_text(folder / "meta.json", json.dumps(meta, indent=1) + "\n")
