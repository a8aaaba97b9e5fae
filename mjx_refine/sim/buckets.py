"""Batch sizes that devices are given, and what becomes of the poses that they return."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeAlias

import numpy as np
from jaxtyping import Array, Float

BUCKETS = (1, 4, 16, 32, 64, 128, 256, 512, 1024, 1536, 2048, 3072, 4096, 6144, 8192)
"""Batch sizes that programs are compiled for; a batch is padded to the next."""

FINE = 128
"""Batches for at least as many candidates are made in multiples of it: thousands fill a GPU."""

SPARE = 1.25
"""A batch with up to this many times the rows serves fewer candidates."""

Launched: TypeAlias = Callable[[], Float[Array, "rows frames objects 7"]]
"""A rollout that a device computes: waits for it."""


def bucket(count: int) -> int:
    """The smallest compiled batch size that holds ``count`` candidates."""
    return next((size for size in BUCKETS if size >= count), -(-count // BUCKETS[-1]) * BUCKETS[-1])


def rows_for(count: int, there: Iterable[int]) -> int:
    """Rows of a batch for ``count`` candidates: as many as one of those that are there, if hardly more, else a few more."""
    fitting = [size for size in there if count <= size <= SPARE * count]
    return min(fitting, default=bucket(count) if count < FINE else -(-count // FINE) * FINE)


def diverged_to_nan(poses: Float[np.ndarray, "batch frames objects 7"]) -> Float[np.ndarray, "batch frames objects 7"]:
    """NaN from the first frame on in which any coordinate is not finite or any object is over 10 km away."""
    bad = ~np.isfinite(poses).all((2, 3)) | (np.abs(poses[..., :3]) > 1e4).any((2, 3))
    bad = np.logical_or.accumulate(bad, axis=1)
    return np.where(bad[:, :, None, None], np.nan, poses)
