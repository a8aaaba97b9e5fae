"""How far least squares has come on its way through a clip, and where it arrived."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Course:
    """A landing on its way.

    Attributes:
      point: in the unit box.
      cost: half the sum of squares at the last stage.
      known: frames from the first on whose outlines fit.
      stage: the next one of the schedule.
    """

    point: Float[np.ndarray, "dimension"]
    cost: float = np.inf
    known: int = 0
    stage: int = 0


@dataclasses.dataclass(frozen=True)
class Landing:
    """Where least squares arrived.

    Attributes:
      point: in the unit box.
      cost: half the sum of squares at the last stage.
      covariance: inverse curvature of that cost, the prior included, in the unit box.
      sensitivity: change of the residual vector [noise widths] for one prior width of each parameter, without the prior.
      evaluations: rollouts it took, in units of the whole clip.
    """

    point: Float[np.ndarray, "dimension"]
    cost: float
    covariance: Float[np.ndarray, "dimension dimension"]
    sensitivity: Float[np.ndarray, "dimension"]
    evaluations: int
