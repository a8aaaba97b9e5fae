"""CLEVRER's mask proposals: per frame what a detector found, with its attributes; made into one id an object."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from benchmarks.clevrer import plain, rle
from benchmarks.clevrer.annotation import Thing, read_things
from mjx_refine.errors import InputError

COMMON = 0.2  # share of the frames in which a look must be found to be an object, where nothing else names them
OVERLAP = 0.3  # least IoU by which a find with wrong attributes is taken for an object that is missing

Look = tuple[str, str, str]


@dataclass(frozen=True)
class Find:
    """One detection: its look (color, material, shape), score (1 where the file has none) and mask."""

    look: Look
    score: float
    mask: Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class Proposals:
    """All detections of a video.

    Attributes:
      frames: by frame. size: (height, width), pixels. things: the true objects, where the file has `ground_truth`.
      source: of messages.
    """

    frames: tuple[tuple[Find, ...], ...]
    size: tuple[int, int]
    things: tuple[Thing, ...] | None
    source: str

    def looks(self) -> list[Look]:
        """Looks that are found in many frames, the most frequent first."""
        counts = Counter(look for frame in self.frames for look in {find.look for find in frame})
        return [
            look for look, n in sorted(counts.items(), key=lambda c: (-c[1], c[0])) if n >= COMMON * len(self.frames)
        ]


def load_proposals(path: Path) -> Proposals:
    """Reads `proposal_NNNNN.json` (or `sim_NNNNN.json`, which also has `ground_truth`).

    Raises:
      InputError: it cannot be read, or something in it is missing or wrong.
    """
    data = plain.load_json(path, "CLEVRER's mask proposals")
    listed = plain.entries(data, "frames", str(path))
    if not listed:
        raise InputError(f"{path}: frames is empty; expected an entry a frame; get the file again")
    numbered: dict[int, tuple[Find, ...]] = {}
    size: tuple[int, int] | None = None
    for i, frame in enumerate(listed):
        where = f"{path}: frames[{i}]"
        number = (
            plain.whole(frame, "frame_index", where) if not isinstance(frame, dict) or "frame_index" in frame else i
        )
        if number in numbered:
            raise InputError(f"{where}.frame_index = {number} is there twice; expected each frame once; correct it")
        finds = []
        for k, item in enumerate(plain.entries(frame, "objects", where)):
            find = _find(item, f"{where}.objects[{k}]")
            if find.mask.shape != (size or find.mask.shape):
                raise InputError(
                    f"{where}.objects[{k}].mask.size = {list(find.mask.shape)}; expected {list(size or ())}"
                )
            size = find.mask.shape
            finds.append(find)
        numbered[number] = tuple(finds)
    if sorted(numbered) != list(range(len(numbered))):
        lacking = next(n for n in range(len(numbered) + 1) if n not in numbered)
        raise InputError(
            f"{path}: frame {lacking} is missing; expected frame_index 0 to {len(numbered) - 1}; correct it"
        )
    if size is None:
        raise InputError(f"{path}: no object in any frame; expected masks; take another video")
    truth = data.get("ground_truth")
    things = None if truth is None else _truth(truth, path)
    return Proposals(tuple(numbered[n] for n in range(len(numbered))), size, things, str(path))


def _truth(truth: Any, path: Path) -> tuple[Thing, ...]:
    return read_things(
        plain.entries(truth, "objects", f"{path}: ground_truth"), f"{path}: ground_truth.objects", key="id"
    )


def _find(item: Any, where: str) -> Find:
    look = (
        plain.word(item, "color", where),
        plain.word(item, "material", where),
        plain.word(item, "shape", where),
    )
    mask = plain.entry(item, "mask", where)
    size = plain.vector(mask, "size", f"{where}.mask", (2,))
    counts = plain.entry(mask, "counts", f"{where}.mask")
    height, width = (int(n) for n in size)
    if not (8 <= height <= 8192 and 8 <= width <= 8192):
        raise InputError(f"{where}.mask.size = {size}; expected [height, width], 8 to 8192 px each; correct it")
    if not isinstance(counts, str) and not (isinstance(counts, list) and all(type(n) is int for n in counts)):
        raise InputError(f"{where}.mask.counts is a {type(counts).__name__}; expected COCO's text or a list of runs")
    try:
        decoded = rle.decode((height, width), counts)
    except ValueError as error:
        raise InputError(f"{where}.mask.counts: {error}; expected COCO's run lengths; get the file again") from error
    score = item.get("score", 1.0)
    if isinstance(score, bool) or not isinstance(score, int | float):
        raise InputError(f"{where}.score = {str(score)[:40]}; expected a number; correct it")
    return Find(look, float(score), decoded)


def track(proposals: Proposals, looks: list[Look], start: int, stop: int) -> Int[np.ndarray, "frames height width"]:
    """One id an object, 1 + its place in `looks`, in frames `start` to `stop` (exclusive).

    A find belongs to the object that it looks like; of several the one with the best score, then the largest. Where an
    object is missing, a find that looks like none takes its place if it overlaps with it in the frame before. Where
    masks overlap, the better score is in front.
    """
    masks = np.zeros((stop - start, *proposals.size), np.int32)
    before: dict[int, Bool[np.ndarray, "height width"]] = {}
    for t in range(start, stop):
        chosen: dict[int, Find] = {}
        finds = sorted(proposals.frames[t], key=lambda find: (-find.score, -int(find.mask.sum())))
        for find in finds:
            if find.look in looks:
                chosen.setdefault(looks.index(find.look), find)
        for find in finds:
            if find.look not in looks:
                near = {i: _iou(find.mask, mask) for i, mask in before.items() if i not in chosen}
                best = max(near, key=lambda i: near[i], default=-1)
                if best >= 0 and near[best] >= OVERLAP:
                    chosen[best] = find
        for i, find in sorted(chosen.items(), key=lambda item: item[1].score):
            masks[t - start][find.mask] = i + 1
        before = {i: find.mask for i, find in chosen.items()}
    return masks


def _iou(a: Bool[np.ndarray, "height width"], b: Bool[np.ndarray, "height width"]) -> float:
    return float((a & b).sum() / max(int((a | b).sum()), 1))
