"""An effect's fitted numbers, and how well a clip knows them."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Term
from mjx_refine.diagnosis.result import Value

TIED = 0.95
"""Correlation of two numbers of an effect from which a note says so."""


def values_at(clip: ClipFit, fit: Fit, k: int) -> dict[str, Value]:
    """Parameters of one effect with 90 % intervals from the curvature, widened where the fit leaves more than noise."""
    hypothesis = fit.hypothesis
    covariance = np.linalg.inv(fit.curvature) * max(1.0, clip.misfit(fit))
    first = hypothesis.ground + sum(int(o.free.sum()) for o in hypothesis.terms[:k])
    return values_of(hypothesis.terms[k], fit.z[first:], covariance[first:, first:], clip.frames)


def values_of(
    term: Term,
    z: Float[np.ndarray, "coordinates"],
    covariance: Float[np.ndarray, "coordinates coordinates"],
    frames: int,
) -> dict[str, Value]:
    """Parameters of an effect with 90 % intervals; of what has many numbers their root mean square.

    Args:
      term: the effect.
      z: coordinates in prior widths, those that the term leaves free first.
      covariance: of their errors.
      frames: of the clip.
    """
    count = int(term.free.sum())
    values = term.values(z[None, :count])[0]
    slope = term.slope(z[:count])
    wide_all = 1.645 * np.sqrt(np.einsum("ip,ij,jp->p", slope, covariance[:count, :count], slope))
    result: dict[str, Value] = {}
    at = 0
    for p in term.kind.parameters:
        count = 1 if p.length == 0 else (frames if p.length < 0 else p.length)
        part, wide = values[at : at + count], wide_all[at : at + count]
        at += count
        if p.length == 0:
            low, high = max(float(part[0] - wide[0]), p.low), min(float(part[0] + wide[0]), p.high)
            result[p.name] = Value(float(part[0]), low, high, p.unit)
        else:
            centred = part - part.mean() if p.length < 0 else part
            size, error = (float(np.sqrt(np.mean(row**2))) for row in (centred, wide))
            result[f"{p.name}_rms"] = Value(size, max(size - error, 0.0), size + error, p.unit)
    if term.name == "camera_shake":
        halves = values.reshape(2, -1)
        size = float(np.sqrt(np.mean((halves - halves.mean(1, keepdims=True)) ** 2)))
        result["amplitude"] = Value(size, 0.9 * size, 1.1 * size, "degree")
    return result


def tied(fit: Fit) -> list[str]:
    """Sentences about numbers of one effect that do each other's work."""
    covariance = np.linalg.inv(fit.curvature)
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    first, told = fit.hypothesis.ground, []
    for t in fit.hypothesis.terms:
        free = np.nonzero(t.free)[0]
        names = [p.name for p in t.kind.parameters]
        if all(p.length == 0 for p in t.kind.parameters):
            for i, j in itertools.combinations(range(len(free)), 2):
                rho = float(correlation[first + i, first + j])
                if abs(rho) > TIED:
                    told.append(
                        f"{names[free[i]]} and {names[free[j]]} of {t.name} do each other's work in this clip (correlation "
                        f"{rho:.2f}): what is known is their combination."
                    )
        first += len(free)
    return told
