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
from mjx_refine.search.landing import LeastSquares
from mjx_refine.search.schedule import Stage
from mjx_refine.sim.separate import separate
from mjx_refine.space import Space

FITTED = 8
"""Hypotheses, of different families, that a short least squares improves."""

ROLLOUTS = 6000
"""Rollouts times objects that all those fits may take together."""

KINDS = 5
"""Scene kinds among the samples: whoever refines them compiles a program for each."""

DRAWS = 128
"""Points tried around a hypothesis whose objects hit something."""

MOST_ALIKE = 4
"""Samples of one family, unless there are too few families."""


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
    ranked = sorted((_Ranked(float(s), h) for s, h in zip(scores, candidates, strict=True)), key=lambda r: -r.score)
    kinds = list(dict.fromkeys(r.hypothesis.scene.shapes for r in ranked))[:KINDS]
    ranked = [r for r in ranked if r.hypothesis.scene.shapes in kinds]
    fitted = _Fitter(judge, seen, seed)(ranked)
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


class _Fitter:
    """Least squares on outlines, from hypotheses.

    Args:
      judge: of the results.
      seen: the outlines.
      seed: of the points tried around a hypothesis.
    """

    def __init__(self, judge: Judge, seen: Outlines, seed: int):
        self.judge, self.seen, self.seed = judge, seen, seed
        self.columns = tuple(seen.ids.index(track.id) for track in judge.tracks)

    def __call__(self, ranked: list[_Ranked]) -> list[_Ranked]:
        """The best of several families, improved; the most promising of them more than once, from other points."""
        unit = ROLLOUTS // len(self.judge.tracks)
        chosen = [self._improved(self._scattered(r), unit // 24) for r in _spread(_families(ranked), FITTED)]
        for count, limit in ((4, unit // 12), (2, unit // 6)):
            chosen.sort(key=lambda r: -r.score)
            chosen[:count] = [self._improved(self._scattered(r), limit) for r in chosen[:count]]
        return chosen

    def _improved(self, r: _Ranked, limit: int) -> _Ranked:
        """After least squares of at most about ``limit`` rollouts, or as it was where that does not help."""
        scene, judge, length = r.hypothesis.scene, self.judge, len(self.seen.support)
        space = Space.around(scene)
        rollout = judge.simulator(scene.shapes).rollout
        squares = LeastSquares(space, rollout, self.seen, self.columns, judge.size, limit=limit, seed=self.seed)
        points = [space.start]
        for stage in (Stage(max(2, length // 3), 12.0, 3), Stage(length, 12.0, 4), Stage(length, 4.0, 4)):
            points.append(squares.run(points[-1], [stage]).point)
        scores = judge([space.scene_at(p) for p in points])
        best = int(np.argmax(scores))
        if scores[best] <= r.score:
            return r
        return _Ranked(float(scores[best]), Hypothesis(space.scene_at(points[best]), r.hypothesis.family))

    def _scattered(self, r: _Ranked) -> _Ranked:
        """The best of many points around it, in two rounds: what follows an impact is too jagged for derivatives."""
        if all(len(track.pieces) == 1 for track in self.judge.tracks):
            return r
        space = Space.around(r.hypothesis.scene)
        generator = np.random.default_rng(self.seed)
        point, best = space.start, r.score
        for widest in (0.4, 0.15):
            widths = np.geomspace(0.01, widest, DRAWS)[:, None]
            points = point + generator.standard_normal((DRAWS, space.dimension)) * widths * space.sigma
            points = np.clip(points, 0.0, 1.0)
            scores = self.judge.of_batch(space.decode(points))
            if scores.max() > best:
                point, best = points[int(np.argmax(scores))], float(scores.max())
        return _Ranked(best, Hypothesis(space.scene_at(point), r.hypothesis.family))


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
    # The best of every mode and pitch first: a clip often bears several readings equally well.
    best: list[_Ranked] = []
    for r in pool:
        if len(best) < count // 2 and all(r.hypothesis.family[:2] != b.hypothesis.family[:2] for b in best):
            best.append(r)
    for r in pool:
        same = sum(r.hypothesis.family == b.hypothesis.family for b in best)
        if len(best) < count and same < MOST_ALIKE and all(r is not b for b in best):
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
    """A fifth of a prior width, at random, in every parameter."""
    space = Space.around(scene)
    point = space.start + 0.2 * space.sigma * generator.standard_normal(space.dimension)
    return space.scene_at(np.clip(point, 0.0, 1.0))
