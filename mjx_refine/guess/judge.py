"""How well a scene replays the observed outlines: simulated by C MuJoCo, compared as convex polygons, without drawing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_refine.batch import SceneBatch, batch_from_scenes
from mjx_refine.guess.tracks import Track
from mjx_refine.scene import Scene, Shape
from mjx_refine.search.features import DIRECTIONS
from mjx_refine.sim.c import MujocoSimulator
from mjx_refine.view.outline import directions, supports

GRID = 20
"""Samples along each side of the box in which two outlines are compared."""

CHUNK = 32
NEARNESS = 0.2
"""Weight of the distance between centres: ranks scenes that overlap nowhere."""


class Judge:
    """Scores scenes of any kind against the tracks; object n is track n.

    Args:
      tracks: the objects.
      fps: frames a second.
      size: (width, height) [px].
      with_masks: whether an object must not be seen where it has no mask.
    """

    def __init__(self, tracks: tuple[Track, ...], fps: float, size: tuple[int, int], with_masks: bool):
        self.tracks, self.fps, self.size, self.with_masks = tracks, fps, size, with_masks
        self.simulators: dict[tuple[Shape, ...], MujocoSimulator] = {}
        self.length = len(tracks[0].seen)

    def simulator(self, shapes: tuple[Shape, ...]) -> MujocoSimulator:
        """C MuJoCo for a scene kind."""
        if shapes not in self.simulators:
            self.simulators[shapes] = MujocoSimulator(shapes, self.fps)
        return self.simulators[shapes]

    def __call__(self, scenes: list[Scene]) -> Float[np.ndarray, "scenes"]:
        """Mean overlap of objects and frames, 0 to 1, with a little for nearness; -1 where a simulation diverges."""
        scores = np.full(len(scenes), -1.0)
        kinds: dict[tuple[Shape, ...], list[int]] = {}
        for row, scene in enumerate(scenes):
            kinds.setdefault(scene.shapes, []).append(row)
        for rows in kinds.values():
            for k in range(0, len(rows), CHUNK):
                part = rows[k : k + CHUNK]
                scores[part] = self.of_batch(batch_from_scenes([scenes[row] for row in part]))
        return scores

    def of_batch(self, batch: SceneBatch) -> Float[np.ndarray, "batch"]:
        """Ditto for candidates of one kind."""
        poses = self.simulator(batch.shapes).rollout(batch, self.length)
        bad = ~np.asarray(np.isfinite(poses).all((1, 2, 3)))
        poses = np.where(bad[:, None, None, None], [0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 0.0], poses)
        reach = supports(poses, batch, self.size, DIRECTIONS).astype(np.float64)
        parts = [self._object(reach[:, :, n], track) for n, track in enumerate(self.tracks)]
        return np.where(bad, -1.0, np.mean(parts, axis=0))

    def _object(self, reach: np.ndarray, track: Track) -> np.ndarray:
        """(scenes,) of one object, over the frames that count."""
        half, quarter = DIRECTIONS // 2, DIRECTIONS // 4
        centre = np.stack([reach[..., 0] - reach[..., half], reach[..., quarter] - reach[..., quarter + half]], -1) / 2
        away = np.linalg.norm(centre[:, track.seen] - track.centre[track.seen], axis=-1)
        nearness = np.mean(1 / (1 + away / track.diameter), axis=-1)
        seen = np.nonzero(track.seen & np.isfinite(track.support).any(-1))[0]
        frames = seen if len(seen) else np.nonzero(track.seen)[0]
        close = np.linalg.norm(centre[:, frames] - track.centre[frames], axis=-1) < 2 * reach_width(reach[:, frames])
        overlap = np.zeros((len(reach), len(frames)))
        for row, k in zip(*np.nonzero(close), strict=True):
            overlap[row, k] = _overlap(reach[row, frames[k]], track.support[frames[k]])
        count = np.full(len(reach), float(len(frames)))
        if self.with_masks:
            absent = centre[:, ~track.seen]
            count += ((absent > 0) & (absent < np.array(self.size))).all(-1).sum(-1)
        return overlap.sum(-1) / count + NEARNESS * nearness


def reach_width(reach: np.ndarray) -> np.ndarray:
    """Mean width of outlines [px]."""
    return (
        2 * reach.mean(-1)
        if reach.ndim == 1
        else (reach[..., : DIRECTIONS // 2] + reach[..., DIRECTIONS // 2 :]).mean(-1)
    )


_NORMALS = directions(DIRECTIONS)
_AXES = (0, DIRECTIONS // 4, DIRECTIONS // 2, 3 * DIRECTIONS // 4)


def _overlap(simulated: np.ndarray, observed: np.ndarray) -> float:
    """Intersection over union of two convex outlines; a direction that was not observed agrees."""
    observed = np.where(np.isfinite(observed), observed, simulated)
    right, down, left, up = (max(simulated[k], observed[k]) for k in _AXES)
    # Support functions of the same outline: the box spans from -left to right.
    x = -left + (np.arange(GRID) + 0.5) * (right + left) / GRID
    y = -up + (np.arange(GRID) + 0.5) * (down + up) / GRID
    along = x[None, :, None] * _NORMALS[:, 0] + y[:, None, None] * _NORMALS[:, 1]
    first, second = (along <= simulated).all(-1), (along <= observed).all(-1)
    return float((first & second).sum() / max((first | second).sum(), 1))
