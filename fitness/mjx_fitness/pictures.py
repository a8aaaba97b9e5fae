"""Sums over whole pictures in plain numpy: the reference for every faster version."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from mjx_fitness.sums import Scores, Sums, Weights, scores_from_sums

UNMATCHED = -1
"""Stands for the mask id of an object that no mask belongs to."""


def picture_sums(
    masks: Int[np.ndarray, "frames height width"],
    flow: Float[np.ndarray, "intervals height width 2"],
    observed_masks: Int[np.ndarray, "frames height width"],
    observed_flow: Float[np.ndarray, "intervals height width 2"],
    matching: Sequence[int],
) -> Sums:
    """Sums of one candidate (batch 1).

    Args:
      masks: simulated ids, object n has n + 1.
      flow: simulated [px/frame].
      observed_masks: observed ids, any numbers, 0 is the background.
      observed_flow: [px/frame], NaN where not measured.
      matching: for each object the observed id that belongs to it, or ``UNMATCHED``.

    Raises:
      ValueError: the pictures' shapes differ.
    """
    for name, a, b in (("masks", masks, observed_masks), ("flow", flow, observed_flow)):
        if a.shape != b.shape:
            raise ValueError(f"{name}: simulated {a.shape}, observed {b.shape}; expected equal shapes")
    simulated, observed = masks > 0, observed_masks > 0
    objects = np.stack([masks == n + 1 for n in range(len(matching))], -1)
    matched = np.stack([observed_masks == i if i != UNMATCHED else np.zeros_like(observed) for i in matching], -1)
    error = np.linalg.norm(flow.astype(np.float64) - observed_flow.astype(np.float64), axis=-1)
    valid = np.isfinite(error)
    error = np.where(valid, error, 0.0)
    on_objects = observed[:-1] & valid

    def total(pixels: np.ndarray) -> np.ndarray:
        return pixels.sum((1, 2), dtype=np.float64)[None]

    return Sums(
        intersection=total(simulated & observed),
        union=total(simulated | observed),
        object_intersection=total(objects & matched),
        object_union=total(objects | matched),
        error=total(error),
        measured=total(valid),
        object_error=total(np.where(on_objects, error, 0.0)),
        object_measured=total(on_objects),
    )


def score_pictures(
    masks: Int[np.ndarray, "frames height width"],
    flow: Float[np.ndarray, "intervals height width 2"],
    observed_masks: Int[np.ndarray, "frames height width"],
    observed_flow: Float[np.ndarray, "intervals height width 2"],
    matching: Sequence[int],
    weights: Weights | None = None,
) -> Scores:
    """``picture_sums``, then ``scores_from_sums``."""
    return scores_from_sums(picture_sums(masks, flow, observed_masks, observed_flow, matching), weights)
