"""Fitted effects, by how far their evidence leads the base model's."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

from mjx_refine.diagnosis.fit import Fit
from mjx_refine.diagnosis.fitted import Explained

DOUBT = {"friction_patch": 30.0}
"""Lead that is taken off: no two engines slow bodies down alike, and a patch can imitate much of that."""


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
class Compared:
    """All hypotheses of one clip.

    Attributes:
      base: the base model's fit.
      candidates: single effects, the best evidence first.
      pairs: two effects, the best evidence first.
      impacts: how many impacts were allowed slack.
    """

    base: Fit
    candidates: tuple[Candidate, ...]
    pairs: tuple[Candidate, ...]
    impacts: int


class Weighed(Protocol):
    """A fit of one clip or of several."""

    @property
    def evidence(self) -> float: ...

    @property
    def hypothesis(self) -> Any: ...


def lead_of(fit: Weighed, base: Weighed) -> float:
    """Of a fit's evidence over the base model's."""
    return fit.evidence - base.evidence - sum(DOUBT.get(t.name, 0.0) for t in fit.hypothesis.terms)
