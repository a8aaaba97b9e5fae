"""What is settled of a clip's residuals while it is fitted: its noise, and what may be off without being blamed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from jaxtyping import Float
from numpy import concatenate, ndarray

from mjx_refine.diagnosis.seen.measure import Measured, Parts
from mjx_refine.diagnosis.seen.noise import Counts, Noise


@dataclasses.dataclass(frozen=True)
class Loose:
    """What may be off without being blamed.

    Attributes:
      always: whatever contacts do, one standard deviation a row.
      kicks: errors of contacts, one standard deviation a row, or None.
      blurred: the noise with what the uncertain moment of impacts adds, times a factor.
    """

    always: Parts
    kicks: Parts | None
    blurred: Callable[[float], Noise]

    def columns(
        self, slackness: float, white: Callable[[Parts, None, float], ndarray]
    ) -> Float[ndarray, "residuals columns"]:
        """One standard deviation a column, contacts' times ``slackness``; ``white`` makes noise widths of changes."""
        always = white(self.always, None, 1e9).T
        if self.kicks is None or slackness == 0:
            return always
        return concatenate([always, white(self.kicks, None, 1e9 / slackness).T * slackness], 1)


@dataclasses.dataclass(frozen=True)
class Settled:
    """All that residuals depend on beside the clip itself and the hypothesis.

    Attributes:
      measured: with its noise.
      noise: standard deviations.
      counts: as how many independent numbers measurements count.
      columns: what the residuals may err by, one standard deviation a column; None: nothing.
    """

    measured: Measured
    noise: Noise
    counts: Counts
    columns: Float[ndarray, "residuals columns"] | None
