"""A video cut into one-second clips of what moves."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Int

from benchmarks.clevrer.annotation import Annotation, Thing
from benchmarks.clevrer.proposals import Look, Proposals, track
from mjx_refine.errors import InputError
from mjx_refine.files import write_text
from mjx_refine.observation import make_observation, save_observation
from mjx_refine.observe.flow import measure_flow
from mjx_refine.observe.video import Clip, read_clip

STILL = 0.02  # world units; an annotated object that stays nearer to where it was is static
TURNED = 0.05  # rad; and turns less
STILL_PIXELS = 2.0  # ditto of a mask's centroid, where there is no annotation
WHOLE = 0.9  # share of its greatest area at which a mask counts as not hidden
LEAST_PIXELS = 8000  # px an object must show in 30 frames of 480x320


@dataclass(frozen=True)
class Cut:
    """What became of one window of a video.

    Attributes:
      name: of its folder. first: its first frame. kept, static: looks of objects that are in the masks, and that were
        dropped. fault: why no clip was written, or None.
    """

    name: str
    first: int
    kept: tuple[Look, ...]
    static: tuple[Look, ...]
    fault: str | None


def cut_video(
    video: Path,
    proposals: Proposals,
    annotation: Annotation | None,
    out: Path,
    *,
    number: int,
    seconds: float = 1.0,
    fps: float | None = None,
    least_pixels: int = LEAST_PIXELS,
) -> list[Cut]:
    """Writes `out/NNNNN_FFF/flows.npz` and `annotation.json` for every whole window in which something moves.

    Static objects belong to the background: they have no id in the masks. A window is left out where nothing moves, or
    where an object that moves shows fewer than `least_pixels` (in proportion at other sizes and lengths). Windows
    whose `flows.npz` is there are left alone.

    Args:
      video: mp4. proposals: of its masks. annotation: of its objects; without it all is told from masks.
      out: folder. number: the video's, for names. seconds: a clip's length. fps: None takes the file's.
      least_pixels: 0 takes all.

    Raises:
      InputError: the files do not fit together, or cannot be read.
    """
    clip = read_clip(video, fps=fps)
    _fit(video, clip, proposals, annotation)
    length = round(seconds * clip.fps)
    if not 2 <= length <= len(clip.frames):
        raise InputError(
            f"{video}: windows of {seconds:g} s are {length} frames at {clip.fps:g} fps; expected 2 to {len(clip.frames)}; "
            "change --seconds or --fps"
        )
    looks, things = identities(proposals, annotation)
    found = []
    for first in range(0, len(clip.frames) - length + 1, length):
        span = (first, first + length)
        masks = track(proposals, looks, *span)
        static = {i for i in range(len(looks)) if is_static(masks, i, annotation, things, span)}
        masks[np.isin(masks, [i + 1 for i in static])] = 0
        shown = [i for i in range(len(looks)) if (masks == i + 1).any()]
        fault = _fault(masks, shown, least_pixels)
        name = f"{number:05d}_{first:03d}"
        kept, dropped = tuple(looks[i] for i in shown), tuple(looks[i] for i in sorted(static))
        if fault is None and not (out / name / "flows.npz").exists():
            _write(out / name, clip, masks, span, _window(annotation, things, shown, looks, span, clip.fps))
        found.append(Cut(name, first, kept, dropped, fault))
    return found


def _fit(video: Path, clip: Clip, proposals: Proposals, annotation: Annotation | None) -> None:
    frames, (height, width) = len(clip.frames), clip.frames.shape[1:3]
    if len(proposals.frames) != frames:
        raise InputError(f"{proposals.source}: {len(proposals.frames)} frames; expected {frames} as {video} has")
    if proposals.size != (height, width):
        raise InputError(
            f"{proposals.source}: masks of {proposals.size[1]}x{proposals.size[0]}; expected {width}x{height}"
        )
    if annotation is not None and annotation.length != frames:
        raise InputError(f"{annotation.source}: {annotation.length} frames; expected {frames} as {video} has")


def identities(proposals: Proposals, annotation: Annotation | None) -> tuple[list[Look], list[Thing] | None]:
    """Looks of a video's objects: the annotation's, else the proposals' truth, else those that are found often."""
    things = annotation.things if annotation is not None else proposals.things
    if things is not None:
        return [thing.look for thing in things], list(things)
    return proposals.looks(), None


def is_static(
    masks: Int[np.ndarray, "frames height width"],
    index: int,
    annotation: Annotation | None,
    things: list[Thing] | None,
    span: tuple[int, int],
) -> bool:
    """Whether an object stays where it is throughout a window: by the annotation, else by its mask while not hidden."""
    if annotation is not None and things is not None:
        place = annotation.location[span[0] : span[1], index]
        turn = np.unwrap(annotation.orientation[span[0] : span[1], index], axis=0)
        moved = np.linalg.norm(place - place[0], axis=-1).max()
        return bool(moved < STILL and np.abs(turn - turn[0]).max() < TURNED)
    areas = (masks == index + 1).sum((1, 2))
    clear = np.flatnonzero((areas > 0) & (areas >= WHOLE * areas.max()))
    if not clear.size:
        return True
    centres = np.array([np.mean(np.nonzero(masks[t] == index + 1), axis=1) for t in clear])
    return bool(np.linalg.norm(centres - centres[0], axis=-1).max() < STILL_PIXELS)


def _fault(masks: Int[np.ndarray, "frames height width"], shown: list[int], least_pixels: int) -> str | None:
    if not shown:
        return "nothing moves"
    least = least_pixels * masks[0].size / (480 * 320) * len(masks) / 30
    areas = {i: int((masks == i + 1).sum()) for i in shown}
    few = [f"{areas[i]} px" for i in shown if areas[i] < least]
    return f"an object shows {few[0]} in total, fewer than {least:.0f}" if few else None


def _window(
    annotation: Annotation | None,
    things: list[Thing] | None,
    shown: list[int],
    looks: list[Look],
    span: tuple[int, int],
    fps: float,
) -> dict[str, Any]:
    """What the annotation says of a window; frames count from its first."""
    first, stop = span
    objects = []
    for i in shown:
        color, material, shape = looks[i]
        told: dict[str, Any] = {"mask_id": i + 1, "shape": shape, "color": color, "material": material}
        if things is not None:
            told["object_id"] = things[i].number
        if annotation is not None:
            for key in ("location", "orientation", "velocity", "angular_velocity"):
                told[key] = np.round(getattr(annotation, key)[first:stop, i], 5).tolist()
        objects.append(told)
    numbers = {thing.number for i, thing in enumerate(things or []) if i in shown}
    meetings = [] if annotation is None else annotation.collisions
    return {
        "first_frame": first,
        "fps": fps,
        "objects": objects,
        "collisions": [
            {"object_ids": list(m.objects), "frame": m.frame - first, "location": m.location}
            for m in meetings
            if first <= m.frame < stop and numbers & set(m.objects)
        ],
    }


def _write(
    folder: Path, clip: Clip, masks: Int[np.ndarray, "frames height width"], span: tuple[int, int], told: dict[str, Any]
) -> None:
    """Writes a clip; `flows.npz` comes last, so that a folder that has it is whole."""
    cv2.setNumThreads(1)
    frames = clip.frames[span[0] : span[1]]
    field = measure_flow(frames, masks)
    observation = make_observation(field.flow, clip.fps, masks, frames, field.sigma)
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "annotation.json", json.dumps(told, indent=1) + "\n")
    save_observation(folder / "flows.npz", observation)
