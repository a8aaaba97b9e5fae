"""What a long run tells while it runs; a display implements it, nothing here prints."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Step:
    """One step of a search: a row of ``history.csv``.

    Attributes:
      phase: ``land`` (least squares) or ``search`` (population).
      iteration: counted within the phase.
      evaluations: rollouts so far, over all phases.
      budget: rollouts that may be spent.
      seconds: since the run began.
      fitness, iou, epe: of the best candidate so far, at the search's resolution [1, 1, px].
      spread: ``land``: frames in the horizon; ``search``: mean standard deviation of the population, unit box.
    """

    phase: str
    iteration: int
    evaluations: int
    budget: int
    seconds: float
    fitness: float
    iou: float
    epe: float
    spread: float


class Progress:
    """A display that shows nothing."""

    def message(self, text: str) -> None:
        """Something that the user should know."""

    def step(self, step: Step) -> None:
        """A step was done."""

    def close(self) -> None:
        """The run is over."""
