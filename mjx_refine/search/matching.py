"""Which mask belongs to which object of a starting scene."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from mjx_fitness import match_costs

from mjx_refine.batch import SceneBatch
from mjx_refine.search.features import DIRECTIONS, Outlines
from mjx_refine.view.outline import supports

FIRST_FRAMES = 3
"""Frames in which object and mask are compared: a rough start goes wrong later."""


def frames_to_match(seen: Outlines) -> int:
    """Frames of a rollout that ``match_objects`` needs: more than ``FIRST_FRAMES`` where a mask appears late."""
    return 1 + max(
        (int(_first_seen(seen, j)[-1]) for j in range(len(seen.ids)) if len(_first_seen(seen, j))), default=0
    )


def _first_seen(seen: Outlines, j: int) -> np.ndarray:
    return np.nonzero(np.isfinite(seen.centre[:, j, 0]))[0][:FIRST_FRAMES]


def match_objects(
    poses: Float[np.ndarray, "frames objects 7"], batch: SceneBatch, row: int, seen: Outlines, image: tuple[int, int]
) -> tuple[int, ...]:
    """Assigns masks to objects by place and size in the first frames where each mask is seen (Hungarian).

    Outlines, not overlap, so that an object that starts beside its mask still finds it.

    Args:
      poses: of one candidate, at least ``frames_to_match`` frames.

    Returns:
      for each object its mask's id, or ``UNMATCHED``.
    """
    reach = supports(poses[None], batch[row : row + 1], image, DIRECTIONS)[0]
    quarter = DIRECTIONS // 4
    right, down, left, up = (reach[..., k * quarter] for k in range(4))
    centre = np.stack([(right - left) / 2, (down - up) / 2], -1)
    width = (reach[..., : DIRECTIONS // 2] + reach[..., DIRECTIONS // 2 :]).mean(-1)
    costs = np.full((poses.shape[1], len(seen.ids)), np.inf)
    for j in range(len(seen.ids)):
        visible = _first_seen(seen, j)
        if len(visible) == 0:
            continue
        extent = 2 * np.sqrt(np.maximum(seen.area[visible, j], 1.0) / np.pi)
        for n in range(poses.shape[1]):
            away = np.linalg.norm(centre[visible, n] - seen.centre[visible, j], axis=-1)
            other_size = np.abs(np.log(np.maximum(width[visible, n], 1e-3) / extent))
            costs[n, j] = np.mean(away / (0.1 * image[0]) + other_size)
    return match_costs(np.nan_to_num(costs, nan=np.inf, posinf=np.inf), list(seen.ids))
