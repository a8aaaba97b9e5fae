"""COCO's run-length masks: column after column, runs of 0 and 1 in turn, as lists of numbers or as compact text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

_FIRST = 48  # "0"; each character carries five bits and says in the sixth whether more follow


def text_to_runs(text: str) -> list[int]:
    """Lengths of runs from compact text; from the fourth on, each is coded as the difference to the one two before.

    Raises:
      ValueError: a character is none of the code's, or the text ends within a number.
    """
    runs: list[int] = []
    value = shift = 0
    for place, character in enumerate(text):
        code = ord(character) - _FIRST
        if not 0 <= code < 64:
            raise ValueError(f"character {character!r} at {place} is none of the code's")
        value |= (code & 31) << shift
        shift += 5
        if shift > 60:
            raise ValueError(f"a number at {place} is too long")
        if not code & 32:
            value -= (1 << shift) if code & 16 else 0  # the sign bit of its last five
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("the text ends within a number")
    return runs


def runs_to_text(runs: Sequence[int]) -> str:
    """The inverse of `text_to_runs`."""
    text = []
    for place, run in enumerate(runs):
        value = int(run) - (int(runs[place - 2]) if place > 2 else 0)
        while True:
            bits, value = value & 31, value >> 5
            more = value != (-1 if bits & 16 else 0)
            text.append(chr(_FIRST + bits + (32 if more else 0)))
            if not more:
                break
    return "".join(text)


def decode(size: tuple[int, int], counts: str | Sequence[int]) -> Bool[np.ndarray, "height width"]:
    """The mask.

    Args:
      size: (height, width), pixels. counts: runs, or text of them.

    Raises:
      ValueError: the runs do not fill the picture exactly.
    """
    runs = text_to_runs(counts) if isinstance(counts, str) else [int(run) for run in counts]
    height, width = size
    if min(runs, default=0) < 0 or sum(runs) != height * width:
        raise ValueError(f"runs sum to {sum(runs)}; expected {height} x {width} = {height * width}")
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs).reshape(width, height).T


def encode(mask: Bool[np.ndarray, "height width"]) -> dict:
    """`{"size": [height, width], "counts": text}`."""
    flat = np.asarray(mask, bool).T.ravel()
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flat]).astype(np.int8))) if flat.size else np.zeros(0, int)
    runs = np.diff(np.concatenate([[0], edges, [flat.size]]))
    return {"size": [int(n) for n in mask.shape], "counts": runs_to_text(runs.tolist())}
