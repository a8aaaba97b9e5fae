"""What many refinements tell while they run; a display implements it, nothing here prints."""

from __future__ import annotations

from mjx_refine.many.outcome import Outcome


class ManyProgress:
    """A display that shows nothing."""

    def update(self, finished: int, total: int, part: float, running: tuple[str, ...]) -> None:
        """Where the whole stands.

        Args:
          finished: jobs that have ended, well or not.
          total: jobs.
          part: of all the work that is done, in [0, 1]; jobs at work count by the rollouts that they have spent.
          running: names of the jobs at work.
        """

    def ended(self, outcome: Outcome) -> None:
        """A job has ended."""

    def close(self) -> None:
        """All is over."""
