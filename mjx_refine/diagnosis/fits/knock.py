"""What an impact with something unseen may err by: nobody knows what it is made of.

An obstacle's face is a plane that pushes through one point and rubs as the floor does. What a body really hits gives
another impulse, and without this a push through the centre, which may have any direction, explains that better.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.hypothesis import Hypothesis
from mjx_refine.diagnosis.fits.pace import FAR_BEHIND
from mjx_refine.diagnosis.fits.slack import Impact, spins

BLOW = 0.25
"""Standard deviation of such an impulse's error, as a part of the change of velocity."""

ROUNDS, ITERATIONS = 2, 8
"""How often the impact is looked for again where least squares ended, and of least squares."""

HOPE, LITTLE = 2.0, 20.0
"""Multiple of a rival's cost above which a fit is left as it is; gain in evidence below which the impact is not looked for
again."""

MOVED = 1e-4
"""Distance from the path without the effect from which on the impact has been [m]."""


def knocked(clip: ClipFit, fit: Fit, rival: float = np.inf) -> Fit:
    """The fit once contacts along its own path, and its impacts with unseen things, may err; the same where that explains
    less, or where it costs far more than ``rival``."""
    for _ in range(ROUNDS):
        if fit.cost > HOPE * rival + FAR_BEHIND:
            break
        terms = tuple(
            dataclasses.replace(t, excused=excuses(clip, fit.hypothesis, fit.z, k)) if t.kind.strikes else t
            for k, t in enumerate(fit.hypothesis.terms)
        )
        own = dataclasses.replace(fit.hypothesis, terms=terms, slack=clip.slack_along(fit))
        if own.slack is None and own.excused is None:
            break
        trial = clip.fit(own, fit.z, ITERATIONS, rival=rival)
        gain = trial.evidence - fit.evidence
        fit = trial if gain > 0 else fit
        if gain < LITTLE:
            break
    return fit


def to_the_end(clip: ClipFit, fit: Fit, iterations: int, rival: float) -> Fit:
    """A fit that was interrupted, at its end, its impacts with unseen things as they may err."""
    return knocked(clip, fit if fit.ended else clip.gone_on(fit, iterations, rival, thorough=False), rival)


def strike_notes(hypothesis: Hypothesis, names: Sequence[str]) -> list[str]:
    """Sentences about impacts with unseen things that may err in a fit, and do not in a scene that is replayed."""
    return [
        f"What {names[t.target]} gets from the {t.name} may err by {BLOW:.0%} of its change of velocity: the fit follows the "
        "clip after that impact, the replayed scene, in which nothing errs, only as far as such an impact is known."
        for t in hypothesis.terms
        if t.excused is not None and t.excused.size
    ]


def excuses(
    clip: ClipFit, hypothesis: Hypothesis, z: Float[np.ndarray, "dimension"], k: int
) -> Float[np.ndarray, "residuals columns"] | None:
    """What the first impact of term ``k`` may err by, one standard deviation a column; None where there is none."""
    z, fps = z[None], clip.simulator.fps
    batch = hypothesis.batch(z)
    free = dataclasses.replace(batch, effects=batch.effects[:k] + batch.effects[k + 1 :])
    poses, plain = clip.poses(hypothesis, z)[0], clip.rollout(free, clip.frames)[0]
    if not (np.isfinite(poses).all() and np.isfinite(plain).all()):
        return None
    target = hypothesis.terms[k].target
    apart = np.linalg.norm(poses[:, target, :3] - plain[:, target, :3], axis=-1)
    parted = np.nonzero(apart > MOVED)[0]
    if len(parted) == 0 or parted[0] >= len(poses) - 2:
        return None
    # The body may still touch in the first frame that differs.
    frame = int(parted[0]) + 1
    change = (poses[frame + 1] - poses[frame] - plain[frame + 1] + plain[frame])[target, :3] * fps
    turn = (spins(poses, fps)[frame] - spins(plain, fps)[frame])[target]
    size = float(batch.size[0, target].max())
    impact = Impact(target, frame, float(np.linalg.norm(change)), float(np.linalg.norm(turn)) * size)
    still = clip.predictor(poses[None], batch)
    return clip.rigid(clip.kicks(batch, poses, still, [impact], BLOW), None, 1e9).T
