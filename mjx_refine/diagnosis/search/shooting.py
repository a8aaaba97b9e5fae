"""Hypotheses with states of their own after impacts (``nodes``): there least squares see no jags, and what two engines' bounces
differ by bends nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from mjx_refine.diagnosis.fits.candidates import Candidate
from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.knock import knocked
from mjx_refine.diagnosis.fits.nodes import COORDINATES, nodes_of
from mjx_refine.diagnosis.fits.slack import states, touching
from mjx_refine.diagnosis.search.exchange import Fitted

KEPT = 8
"""Effects that were found without nodes and are fitted with them."""

FIRST, ITERATIONS = 14, 12
"""Of least squares, at first and when noise has been taken anew."""


def with_nodes(clip: ClipFit, fit: Fit) -> Fit:
    """A fit with nodes along its path, at its numbers; the same where nothing hits anything and flies on. Its derivatives are not
    to be used."""
    if (along := clip.contacts_along(fit)) is None:
        return fit
    batch, poses, (found, _) = along
    velocity, spin = states(clip.simulator, batch, poses)
    nodes = nodes_of(batch, poses, velocity, spin, touching(batch, poses), found, clip.simulator.fps)
    if not nodes:
        return fit
    ground = fit.hypothesis.ground
    z = np.concatenate([fit.z[:ground], np.zeros(COORDINATES * len(nodes)), fit.z[ground:]])
    return dataclasses.replace(fit, hypothesis=dataclasses.replace(fit.hypothesis, nodes=nodes), z=z)


def with_nodes_of(fit: Fit, other: Fit) -> Fit:
    """A fit's hypothesis with another's nodes, at its own numbers and the other's states; its derivatives are not to be used."""
    ground, their = fit.hypothesis.ground, other.hypothesis
    z = np.concatenate([fit.z[:ground], other.z[their.space.dimension : their.ground], fit.z[ground:]])
    return dataclasses.replace(fit, hypothesis=dataclasses.replace(fit.hypothesis, nodes=their.nodes), z=z)


def base_with_nodes(clip: ClipFit, base: Fit, theres: Sequence[Fit], seed: int) -> Fit:
    """The base model's fit with nodes, and noise as it is taken from what that leaves.

    Args:
      clip: residuals.
      base: the base model's fit without nodes.
      theres: fits with nodes, of the base model or with an effect, which then is gone; whose nodes explain most are kept.
      seed: of what is drawn.
    """
    rows: list[tuple[Fit, int]] = []
    for there in theres:
        plain = dataclasses.replace(there.hypothesis, terms=(), slack=None)
        bare = dataclasses.replace(there, hypothesis=plain, z=there.z[: plain.dimension])
        rows += [(with_nodes_of(base, there), FIRST), (bare, FIRST)]
    fits = clip.crew.each(clip, _fitted, rows)
    pairs = zip(fits[::2], fits[1::2], strict=True)
    found = max((min(two, key=lambda fit: fit.cost) for two in pairs), key=lambda fit: fit.evidence)
    clip.settle_noise(found)
    clip.allow_chaos(found, seed)
    clip.allow_slack(found)
    return _fitted(clip, found, ITERATIONS)


def found_before(clip: ClipFit, base: Fit, before: tuple[Candidate, ...]) -> Fitted:
    """Effects that were found without nodes, with those of ``base``."""
    fits = clip.crew.each(clip, _fitted, [(with_nodes_of(one.fit, base), ITERATIONS) for one in before[:KEPT]])
    return {o.effects[0]: (fit, o.promise) for o, fit in zip(before, fits, strict=False)}


def _fitted(clip: ClipFit, there: Fit, iterations: int) -> Fit:
    """Least squares from where a fit stands, with what contacts along its path may err by."""
    hypothesis = dataclasses.replace(there.hypothesis, slack=clip.slack_along(there))
    return knocked(clip, clip.fit(hypothesis, there.z, iterations, thorough=False))
