"""``guess``: many hypotheses, simulated and compared with the clip; the best of each kind fitted a little; the best 32."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_refine.compile_cache import enable_cache
from mjx_refine.errors import InputError
from mjx_refine.guess.hypotheses import Clip, Hypothesis, all_hypotheses
from mjx_refine.guess.judge import Judge
from mjx_refine.guess.tracks import find_tracks
from mjx_refine.observation import Observation
from mjx_refine.scene import Scene
from mjx_refine.search.features import Outlines
from mjx_refine.search.landing import LeastSquares, Stage
from mjx_refine.sim.separate import separate
from mjx_refine.space import Space

FITTED = 8
"""Hypotheses, of different families, that a short least squares improves."""

ROLLOUTS = 2400
"""Rollouts times objects that all those fits may take together."""

LEFT = 0.15
"""Share of the samples kept for families that scored badly."""


@dataclasses.dataclass(frozen=True)
class _Ranked:
    score: float
    hypothesis: Hypothesis


def guess_scenes(observation: Observation, count: int = 32, seed: int = 0) -> list[Scene]:
    """Starting samples from an observation alone, best first.

    Shapes come from outlines, poses from back-projection onto the floor or from the parabola of a free flight, velocities
    from tracks, spins from flow. Each combination with a camera is simulated and compared with the outlines seen.

    Args:
      observation: masks are optional; without them the moving regions of the flow are followed.
      count: how many samples.
      seed: of the variations that fill up the list, and of the fits.

    Raises:
      InputError: nothing is to be seen, or ``count`` or ``seed`` is out of range.
    """
    for name, value, low, high in (("count", count, 1, 1024), ("seed", seed, 0, 2**32 - 1)):
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise InputError(f"{name} = {value!r}; expected a whole number, {low} <= {name} <= {high}")
    enable_cache()
    tracks, seen = find_tracks(observation)
    clip = Clip(tuple(tracks), observation.fps, observation.size)
    judge = Judge(clip.tracks, clip.fps, clip.size, observation.masks is not None)
    candidates = [_apart(h, judge) for h in all_hypotheses(clip)]
    if not candidates:
        raise InputError(f"{observation.source}: no scene explains the masks; expected objects inside the picture")
    scores = judge([h.scene for h in candidates])
    ranked = sorted(
        (_Ranked(float(s), h) for s, h in zip(scores, candidates, strict=True)), key=lambda r: -r.score
    )
    fitted = _fit(ranked, judge, seen, clip, seed)
    return _chosen(fitted, ranked, judge, count, seed)


def _apart(hypothesis: Hypothesis, judge: Judge) -> Hypothesis:
    scene, _ = separate(hypothesis.scene, judge.simulator(hypothesis.scene.shapes), sweeps=30)
    return dataclasses.replace(hypothesis, scene=scene)


def _families(ranked: list[_Ranked]) -> list[_Ranked]:
    """The best of each family, best first."""
    best: dict[tuple, _Ranked] = {}
    for r in ranked:
        best.setdefault(r.hypothesis.family, r)
    return list(best.values())


def _fit(ranked: list[_Ranked], judge: Judge, seen: Outlines, clip: Clip, seed: int) -> list[_Ranked]:
    """The best families after a few steps of least squares, where that helped."""
    columns = tuple(seen.ids.index(track.id) for track in clip.tracks)
    length = len(seen.support)
    chosen = _spread(_families(ranked), FITTED)
    limit = ROLLOUTS // (len(clip.tracks) * max(len(chosen), 1))
    scenes = []
    for r in chosen:
        scene = r.hypothesis.scene
        space = Space.around(scene)
        rollout = judge.simulator(scene.shapes).rollout
        squares = LeastSquares(space, rollout, seen, columns, clip.size, limit=limit, seed=seed)
        point = space.start
        for stage in (Stage(max(2, length // 3), 12.0, 3), Stage(length, 12.0, 4), Stage(length, 4.0, 3)):
            point = squares.run(point, [stage]).point
        scenes.append(space.scene_at(point))
    scores = judge(scenes)
    return [
        _Ranked(float(s), Hypothesis(scene, r.hypothesis.family))
        for s, scene, r in zip(scores, scenes, chosen, strict=True)
        if s > r.score
    ]


def _spread(families: list[_Ranked], count: int) -> list[_Ranked]:
    """``count`` families: half by score alone, half the best of modes and pitches not yet among them."""
    chosen = families[: count // 2]
    for r in families[count // 2 :]:
        if len(chosen) < count and r.hypothesis.family[:2] not in {c.hypothesis.family[:2] for c in chosen}:
            chosen.append(r)
    for r in families:
        if len(chosen) < count and r not in chosen:
            chosen.append(r)
    return chosen


def _chosen(fitted: list[_Ranked], ranked: list[_Ranked], judge: Judge, count: int, seed: int) -> list[Scene]:
    """The best ``count``, a few of every mode and pitch among them, filled up with variations of the best."""
    pool = sorted([*fitted, *ranked], key=lambda r: -r.score)
    reserved = _families(ranked)
    best = pool[: max(1, count - int(LEFT * count))]
    for r in reserved:
        if len(best) < count and all(r.hypothesis.family != b.hypothesis.family for b in best):
            best.append(r)
    for r in pool:
        if len(best) < count and all(r is not b for b in best):
            best.append(r)
    generator = np.random.default_rng(seed)
    while len(best) < count:
        source = pool[int(generator.integers(min(len(pool), 4)))]
        scene = _varied(source.hypothesis.scene, generator)
        best.append(_Ranked(float(judge([scene])[0]), Hypothesis(scene, source.hypothesis.family)))
    return [r.hypothesis.scene for r in sorted(best, key=lambda r: -r.score)]


def _varied(scene: Scene, generator: np.random.Generator) -> Scene:
    """A tenth of a prior width to every side."""
    space = Space.around(scene)
    point = space.start + 0.2 * space.sigma * generator.standard_normal(space.dimension)
    return space.scene_at(np.clip(point, 0.0, 1.0))
