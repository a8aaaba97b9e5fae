"""The scene of a fit as it replays its clip: in a fit contacts may err a little, in a simulation they cannot."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.base import without_grips
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis, Term
from mjx_refine.diagnosis.fits.staged import staged
from mjx_refine.diagnosis.seen.noise import everywhere
from mjx_refine.scene import Scene
from mjx_refine.search.problem import Problem
from mjx_refine.view.effects import needs_pictures

ITERATIONS = 8
"""Of least squares on the whole clip: it begins where the fit with erring contacts ended."""

COARSE = (120, 80)
"""Resolution at which scenes are compared whose every picture is drawn [px]."""


@dataclasses.dataclass(frozen=True)
class Replay:
    """A scene, its mean IoU over the clip, and its end-point error [px]."""

    scene: Scene
    iou: float
    epe: float


def replays(clip: ClipFit, fits: list[Fit], problem: Problem, matching: tuple[int, ...]) -> list[Replay]:
    """For each fit the scene that replays the clip best, its effects as they were fitted; afterwards contacts may not err.

    Least squares goes on over the base parameters alone: on the whole clip, on ever more of it, since what comes after an impact
    may be far off where nothing restarts, and from the replay of the fit before. What they find, where they began, and the
    scene that was given with the effects put in, are compared by fitness, so that no scene replays the clip worse than the
    given one does (where effects change what is seen, as small pictures show it).

    Args:
      clip: its slack is forgotten.
      fits: base model and diagnosed one.
      problem: scores them, by C MuJoCo at full resolution.
      matching: mask id of each object.
    """
    clip.forget_slack(everywhere(clip.measured, clip.frames))
    ways = [(fit, way) for fit in fits for way in (_whole, staged)]
    ended = clip.crew.each(clip, _rigid, ways)
    told: list[Replay] = []
    before: np.ndarray | None = None
    for fit in fits:
        held, here = _held(fit)
        points = [z for z, (one, _) in zip(ended, ways, strict=True) if one is fit]
        if before is not None:
            points.append(_whole(clip, held, before).z)
        replay, before = _best(held, [*points, here, np.zeros(held.dimension)], problem, matching)
        told.append(replay)
    return told


def _whole(clip: ClipFit, hypothesis: Hypothesis, z: np.ndarray) -> Fit:
    return clip.fit(hypothesis, z, ITERATIONS, passing=True)


def _rigid(clip: ClipFit, fit: Fit, way: Callable[[ClipFit, Hypothesis, np.ndarray], Fit]) -> np.ndarray:
    return way(clip, *_held(fit)).z


def _best(
    hypothesis: Hypothesis, points: list[np.ndarray], problem: Problem, matching: tuple[int, ...]
) -> tuple[Replay, Float[np.ndarray, "dimension"]]:
    """The replay of the point that scores best, and that point."""
    scenes = [hypothesis.scene(z, problem.observation.length) for z in points]
    # To draw every picture takes seconds a scene: which is best is seen in small ones.
    drawn = needs_pictures(hypothesis.batch(points[0][None]))
    scores = problem.score(scenes, matching, COARSE if drawn else None)
    best = int(np.argmax(np.nan_to_num(scores.fitness, nan=-np.inf)))
    told = problem.score([scenes[best]], matching).candidate(0) if drawn else scores.candidate(best)
    return Replay(scenes[best], float(told.iou[0]), float(told.epe[0])), points[best]


def _fixed(t: Term, values: np.ndarray) -> Term:
    return dataclasses.replace(t, centre=values, free=np.zeros(len(values), bool), excused=None)


def _held(fit: Fit) -> tuple[Hypothesis, Float[np.ndarray, "dimension"]]:
    """The fit's hypothesis with its effects held at their values and contacts as a scene file has them, and its point."""
    terms = tuple(_fixed(t, fit.hypothesis.values(fit.z[None], k)[0]) for k, t in enumerate(fit.hypothesis.terms))
    space, stay = without_grips(fit.hypothesis.space)
    return dataclasses.replace(fit.hypothesis, space=space, terms=terms, slack=None, nodes=()), fit.z[: len(stay)][stay]
