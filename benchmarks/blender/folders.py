"""Clip folders: small as they are made, with `flows.npz` once they are observed.

`frames.jpg` and `masks.png` are film strips, one frame under the other; a JPEG's blocks are coded apart, so that what
does not change stays exactly the same. Nothing here needs Blender or PyBullet.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from mjx_refine import Job, load_observation, make_observation, save_observation, save_scenes
from mjx_refine.errors import InputError
from mjx_refine.files import write_atomic, write_text
from mjx_refine.guess import guess_scenes
from mjx_refine.observe.flow import measure_flow

QUALITY = 90
SAMPLES = {"perturbed": "best32.yaml", "guess": "guess.yaml"}


def write_strip(path: Path, frames: UInt8[np.ndarray, "frames height width *c"], *options: int) -> None:
    """Frames under one another as one picture; RGB, or one channel."""
    strip = np.ascontiguousarray(frames).reshape(-1, *frames.shape[2:])
    picture = strip[..., ::-1] if strip.ndim == 3 else strip
    done, data = cv2.imencode(path.suffix, picture, list(options))
    if not done:
        raise RuntimeError(f"{path}: OpenCV cannot encode it")
    write_atomic(path, lambda stream: stream.write(data.tobytes()))


def read_strip(path: Path, height: int, colour: bool) -> UInt8[np.ndarray, "frames height width *c"]:
    """Frames of a strip.

    Raises:
      InputError: there is none, or its height is no multiple of a frame's.
    """
    flag = cv2.IMREAD_COLOR_RGB if colour else cv2.IMREAD_UNCHANGED
    strip = cv2.imread(os.fspath(path), flag) if path.is_file() else None
    if strip is None or len(strip) % height or strip.ndim != (3 if colour else 2):
        raise InputError(f"{path}: no strip of frames {height} px high; make the set again")
    return strip.reshape(-1, height, *strip.shape[1:]).astype(np.uint8)


def write_film(folder: Path, film: Any, seed: int) -> None:
    """Writes a `clip.Film`; `meta.json` comes last, so a folder that has it is whole."""
    from benchmarks.blender.clip import FPS, exact_masks
    from benchmarks.clips import samples
    from benchmarks.clips.writing import samples_text, scene_text

    folder.mkdir(parents=True, exist_ok=True)
    drawn, guesses = film.drawn, film.guesses
    write_strip(folder / "frames.jpg", film.frames, cv2.IMWRITE_JPEG_QUALITY, QUALITY)
    write_strip(folder / "masks.png", film.masks, cv2.IMWRITE_PNG_COMPRESSION, 9)
    write_text(folder / "truth.yaml", scene_text(drawn.entries))
    write_text(folder / "best32.yaml", samples_text(guesses.scenes, tagged=seed % 2 == 0, seed=seed))
    names = [entry["name"] for entry in drawn.objects]
    poses = {
        "time": np.arange(len(film.position)) / FPS,
        "pos": np.moveaxis(film.position, 1, 0),
        "quat": np.moveaxis(film.quaternion, 1, 0),
        "names": np.array(names),
    }
    write_atomic(folder / "poses.npz", lambda stream: np.savez_compressed(stream, **poses))
    exact = exact_masks(drawn, film.position, film.quaternion) > 0
    shown = film.masks > 0
    meta = {
        "seed": seed,
        "blender": film.blender,
        "fps": FPS,
        "size": [film.masks.shape[2], film.masks.shape[1]],
        "mask_ids": list(film.mask_ids),
        "looks": [
            {"name": n, "colour": x.colour, "material": x.material} for n, x in zip(names, drawn.looks, strict=True)
        ],
        "restitution": [round(v, 4) for v in drawn.restitution],
        "collisions": [{"objects": [names[i], names[j]], "time": round(t, 4)} for i, j, t in film.collisions],
        "masks_iou_with_rays": round(float((shown & exact).sum() / (shown | exact).sum()), 5),
        "truth_iou_in_mujoco": round(float(samples.sample_iou(drawn.entries, film.masks, fps=FPS).mean()), 4),
        "sample_iou": {
            "mean": round(float(guesses.iou.mean()), 4),
            "best": round(float(guesses.iou.max()), 4),
            "first_frame": round(float(guesses.first_iou.mean()), 4),
        },
    }
    write_text(folder / "meta.json", json.dumps(meta, indent=1) + "\n")


def clip_folders(root: Path) -> list[Path]:
    """The finished clips of a set, sorted.

    Raises:
      InputError: there are none.
    """
    found = sorted(path.parent for path in root.glob("*/meta.json")) if root.is_dir() else []
    if not found:
        raise InputError(
            f"{root}: no clips in it; expected folders with meta.json; `python -m benchmarks.blender make`"
        )
    return found


def read_pictures(
    folder: Path,
) -> tuple[UInt8[np.ndarray, "frames height width 3"], Int[np.ndarray, "frames height width"], float]:
    """Frames, masks and frames a second of a clip.

    Raises:
      InputError: a file is missing or damaged.
    """
    path = folder / "meta.json"
    try:
        meta = json.loads(path.read_text())
        (_, height), fps = meta["size"], float(meta["fps"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); make the clip again") from error
    masks = read_strip(folder / "masks.png", height, False)
    return read_strip(folder / "frames.jpg", height, True), masks.astype(np.int32), fps


def observe(folder: Path) -> str:
    """Measures a clip's flow by OpenCV and writes `flows.npz`, unless it is there."""
    path = folder / "flows.npz"
    if not path.exists():
        cv2.setNumThreads(1)
        frames, masks, fps = read_pictures(folder)
        field = measure_flow(frames, masks)
        save_observation(path, make_observation(field.flow, fps, masks, frames, field.sigma, source=str(path)))
    return folder.name


def guess(folder: Path) -> str:
    """Writes 32 samples made from the observation alone, `guess.yaml`, unless they are there."""
    path = folder / "guess.yaml"
    if not path.exists():
        save_scenes(path, guess_scenes(load_observation(folder / "flows.npz"), 32, 0))
    return folder.name


def jobs(root: Path, samples: str) -> list[Job]:
    """A refinement for every clip of a set.

    Raises:
      InputError: a clip has no flow or no such samples yet.
    """
    found = []
    for folder in clip_folders(root):
        init, video = folder / SAMPLES[samples], folder / "flows.npz"
        for path, step in ((video, "observe"), (init, "guess")):
            if not path.exists():
                raise InputError(f"{path}: not there yet; run `python -m benchmarks.blender {step} {root}` first")
        found.append(Job(init, video, folder.name))
    return found
