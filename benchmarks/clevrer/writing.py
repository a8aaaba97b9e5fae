"""Files in CLEVRER's format, from a simulation of one's own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from benchmarks.clevrer import rle
from benchmarks.clevrer.annotation import Meeting, Thing
from mjx_refine.errors import InputError
from mjx_refine.files import write_text

Places = Float[np.ndarray, "frames objects 3"]


def write_annotation(
    path: Path,
    number: int,
    things: Sequence[Thing],
    motion: dict[str, Places],
    inside: Bool[np.ndarray, "frames objects"],
    collisions: Sequence[Meeting],
) -> None:
    """`annotation_NNNNN.json`.

    Args:
      path: the file. number: of the video. things: the objects. inside: whether the camera sees each.
      motion: `location`, `orientation`, `velocity`, `angular_velocity`. collisions: in time's order.
    """
    frames = [
        {
            "frame_id": t,
            "objects": [
                {
                    "object_id": thing.number,
                    **{key: np.round(values[t, i], 6).tolist() for key, values in motion.items()},
                    "inside_camera_view": bool(inside[t, i]),
                }
                for i, thing in enumerate(things)
            ],
        }
        for t in range(len(inside))
    ]
    told = {
        "scene_index": number,
        "video_filename": f"video_{number:05d}.mp4",
        "object_property": [_property(thing, "object_id") for thing in things],
        "motion_trajectory": frames,
        "collision": [
            {"object_ids": list(m.objects), "frame_id": m.frame, "location": list(m.location or (0.0, 0.0, 0.0))}
            for m in collisions
        ],
    }
    write_text(path, json.dumps(told))


def write_proposals(
    path: Path, number: int, things: Sequence[Thing], masks: Int[np.ndarray, "frames height width"]
) -> None:
    """`proposal_NNNNN.json`; id i + 1 in the masks is the i-th object."""
    frames = [
        {
            "frame_filename": f"video_{number:05d}_frame_{t:05d}.png",
            "frame_index": t,
            "objects": [
                {**_property(thing, None), "score": 1.0, "mask": rle.encode(mask == i + 1)}
                for i, thing in enumerate(things)
                if (mask == i + 1).any()
            ],
        }
        for t, mask in enumerate(masks)
    ]
    write_text(path, json.dumps({"video_index": number, "video_name": f"video_{number:05d}.mp4", "frames": frames}))


def _property(thing: Thing, key: str | None) -> dict[str, Any]:
    told: dict[str, Any] = {} if key is None else {key: thing.number}
    return {**told, "color": thing.color, "material": thing.material, "shape": thing.shape}


def write_video(path: Path, frames: UInt8[np.ndarray, "frames height width 3"], fps: float) -> None:
    """An mp4 of RGB frames.

    Raises:
      InputError: OpenCV has no encoder for it.
    """
    height, width = frames.shape[1:3]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (width, height))
    if not writer.isOpened():
        raise InputError(f"{path}: OpenCV cannot write mp4 here; install an OpenCV with FFmpeg")
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
