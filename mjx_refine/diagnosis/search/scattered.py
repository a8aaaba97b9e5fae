"""Least squares from many places: after contacts they end in whichever of many hollows is nearest, tens of evidence apart.

(Random restarts with early stopping of the poorest, as in successive halving; Jamieson and Talwalkar 2016.)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.candidates import Candidate
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.knock import to_the_end
from mjx_refine.diagnosis.search.exchange import begun_again, held_against
from mjx_refine.diagnosis.search.tempered import COOLER, WARM, cooled, tempered

AROUND: tuple[tuple[float, tuple[float, ...]], ...] = ((2.0, (COOLER,)), (2.0, (WARM, COOLER)), (5.0, (COOLER,)))
"""Draws around a fit: how far [posterior standard deviations], and with which multiples of the noise fits begin there. Of 27
starts, of these kinds and others, that the base models of three clips of the withheld exams had in the end (060 of seed 25, 017
and 048 of seed 26), these and those below brought the most: 17, 223 and 62."""

AFAR: tuple[tuple[float, tuple[float, ...]], ...] = ((0.7, (WARM, COOLER)), (0.3, (COOLER,)))
"""The same around the given scene [prior widths]."""

FAIR, WORTH = 2, 15.0
"""How many of the best effects begin from other places in the end, and the lead from which they do, in units of the misfit left:
half of what the least of them needs to be named."""

WARMING, LOOK, GO_ON, REST = 6, 4, 3, 6
"""Iterations with more noise, steps with the noise as it is after which fits of one hypothesis are compared, how many of them go
on, and for how many iterations."""


def scattered(clip: ClipFit, fits: Sequence[Fit], sources: Sequence[Fit], count: int, seed: int) -> list[Fit]:
    """The fits, or better ones of the same hypotheses from other places.

    Args:
      clip: residuals.
      fits: where least squares ended.
      sources: other hypotheses' fits, whose ordinary numbers are tried as well.
      count: how many numbers are ordinary.
      seed: of the draws.
    """
    rows: list[tuple[Fit, np.ndarray, tuple[float, ...]]] = []
    owners: list[int] = []
    for k, fit in enumerate(fits):
        generator = np.random.default_rng([seed, k])
        starts = _others(fit, sources, count) + _draws(fit, count, generator)
        rows += [(fit, np.clip(z, *fit.hypothesis.bounds), warm) for z, warm in starts]
        owners += [k] * len(starts)
    looks = clip.crew.each(clip, _look, rows)
    near: list[int] = []
    for k in range(len(fits)):
        mine = sorted((i for i, owner in enumerate(owners) if owner == k), key=lambda i: looks[i].cost)
        near += mine[:GO_ON]
    best = list(fits)
    ended = clip.crew.each(clip, to_the_end, [(looks[i], REST, fits[owners[i]].cost) for i in near])
    for i, fit in zip(near, ended, strict=True):
        k = owners[i]
        best[k] = fit if fit.evidence > best[k].evidence else best[k]
    return best


def fairly(
    clip: ClipFit,
    base: Fit,
    singles: tuple[Candidate, ...],
    pairs: tuple[Candidate, ...],
    bound: float,
    seed: int,
) -> tuple[Fit, tuple[Candidate, ...], tuple[Candidate, ...]]:
    """The base model, the best effects and the best two, each from other places as well: what leads must not do so since the
    others ended in worse ones. First the base model, which serves all.

    Args:
      clip: residuals.
      base: the base model's fit.
      singles: every effect by itself, the best first.
      pairs: two effects, the best first.
      bound: lead below which an effect stays where it is.
      seed: of the draws.
    """
    first = [one for one in singles[:FAIR] if one.lead >= bound]
    first += [one for one in pairs[:1] if one.lead > singles[0].lead]
    fits, count = [one.fit for one in first], base.hypothesis.dimension
    (base,) = scattered(clip, [base], fits, count, seed + 1)
    fits = clip.crew.each(clip, begun_again, [(fit, [base], count) for fit in fits])
    fits = scattered(clip, fits, [base, *fits], count, seed + 2)
    base = begun_again(clip, base, fits, count)
    better = {id(one): fit for one, fit in zip(first, fits, strict=True)}

    def moved(kept: tuple[Candidate, ...]) -> list[Candidate]:
        return [dataclasses.replace(one, fit=better.get(id(one), one.fit)) for one in kept]

    return held_against(clip, base, moved(singles), moved(pairs))


def _others(fit: Fit, sources: Sequence[Fit], count: int) -> list[tuple[np.ndarray, tuple[float, ...]]]:
    """Starts at the ordinary numbers that others found."""
    points = [np.concatenate([source.z[:count], fit.z[count:]]) for source in sources]
    return [(point, ()) for point in points if not np.array_equal(point, fit.z)]


def _draws(fit: Fit, count: int, generator: np.random.Generator) -> list[tuple[np.ndarray, tuple[float, ...]]]:
    factor = np.linalg.inv(np.linalg.cholesky(fit.curvature))
    starts = [(fit.z + width * (generator.standard_normal(len(fit.z)) @ factor), warm) for width, warm in AROUND]
    for width, warm in AFAR:
        ordinary = width * generator.standard_normal(count)
        starts.append((np.concatenate([ordinary, fit.z[count:]]), warm))
    return starts


def _look(clip: ClipFit, fit: Fit, z: Float[np.ndarray, "dimension"], warm: tuple[float, ...]) -> Fit:
    """A fit after its first steps from ``z``."""
    there = dataclasses.replace(fit, hypothesis=fit.hypothesis.rigid, z=z)
    for factor in warm:
        with tempered(clip, factor):
            there = clip.fit(there.hypothesis, there.z, WARMING, thorough=False, passing=True)
    # What strikes may not err yet.
    rival = np.inf if fit.hypothesis.strikes else fit.cost
    return clip.fit(cooled(clip, there), there.z, LOOK + REST, rival=rival, attempts=LOOK, thorough=False)
