"""A contact sheet of an exam: a row a clip, frames with their flow and outlines, for a look by eye."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

SHOWN = (0, 5, 10, 15, 20, 25, 28)


def _colours(flow: Float[np.ndarray, "h w 2"], most: float = 10.0) -> UInt8[np.ndarray, "h w 3"]:
    """Direction as hue, length as strength."""
    hue = (np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) % 360 / 2).astype(np.uint8)
    strength = (np.clip(np.linalg.norm(flow, axis=-1) / most, 0, 1) * 255).astype(np.uint8)
    return cv2.cvtColor(np.stack([hue, strength, np.full_like(hue, 220)], -1), cv2.COLOR_HSV2BGR)


def clip_row(folder: Path, title: str) -> UInt8[np.ndarray, "h w 3"]:
    """Some frames of a clip side by side."""
    with np.load(folder / "flows.npz", allow_pickle=False) as data:
        flow, ids = data["flow"].astype(np.float32), data["masks"]
    tiles = []
    for frame in SHOWN:
        tile = _colours(flow[frame])
        for name in np.unique(ids[frame])[1:]:
            edges, _ = cv2.findContours((ids[frame] == name).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(tile, edges, -1, (0, 0, 0), 1)
        tiles.append(cv2.resize(tile, (240, 160), interpolation=cv2.INTER_AREA))
    row = np.hstack(tiles)
    cv2.putText(row, title, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return row


def sheet(exam: Path, numbers: list[str]) -> UInt8[np.ndarray, "h w 3"]:
    """A row for each of the clips."""
    rows = []
    for number in numbers:
        key = json.loads((exam / "key" / f"{number}.json").read_text())
        what = ", ".join(f"{e['effect']} {e['px']} px {_short(e['parameters'])}" for e in key["effects"]) or "none"
        rows.append(clip_row(exam / "clips" / number, f"{number} {key['split']} {key['kind']} {key['flow']}: {what}"))
    return np.vstack(rows)


def _short(parameters: dict) -> str:
    return " ".join(f"{k} {v:.3g}" for k, v in parameters.items() if isinstance(v, int | float))
