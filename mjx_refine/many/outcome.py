"""How one job ended."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

DONE = "done"
SKIPPED = "skipped"
BAD_INPUT = "bad input"
FAILED = "failed"

SCORES = ("iou", "epe", "fitness")


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How one job ended; scores are C MuJoCo's at full resolution, None where there are none.

    Attributes:
      name: of the job and its folder.
      status: ``done``; ``skipped``, finished by an earlier call; ``bad input``; ``failed``, anything else.
      reason: why it was not done, or what is to be known about how it was.
      iou_before, iou_after, epe_before, epe_after, fitness_before, fitness_after: of the best sample and the refined
        scene [1, 1, px, px, 1, 1].
      evaluations: rollouts spent.
      seconds: of the refinement, earlier parts of a resumed one included.
    """

    name: str
    status: str
    reason: str = ""
    iou_before: float | None = None
    iou_after: float | None = None
    epe_before: float | None = None
    epe_after: float | None = None
    fitness_before: float | None = None
    fitness_after: float | None = None
    evaluations: int | None = None
    seconds: float | None = None

    @property
    def ok(self) -> bool:
        """Whether the result is there."""
        return self.status in (DONE, SKIPPED)


FIELDS = tuple(field.name for field in dataclasses.fields(Outcome))


def outcome_of(name: str, status: str, folder: Path, reason: str = "") -> Outcome:
    """The outcome of a job whose ``result.json`` lies in ``folder``."""
    numbers = result_of(folder)
    if numbers is None:
        return Outcome(name, FAILED, f"{folder}: the result cannot be read back")
    scores = {f"{key}_before": numbers["init"][key] for key in SCORES}
    scores.update({f"{key}_after": numbers["refined"][key] for key in SCORES})
    seconds = numbers["seconds"]["total"]
    return Outcome(name, status, reason, **scores, evaluations=numbers["evaluations"], seconds=seconds)


def result_of(folder: Path) -> dict[str, Any] | None:
    """What ``result.json`` in ``folder`` holds; None where there is none that can be read."""
    try:
        numbers = json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return None
    needed = ("init", "refined", "seconds", "evaluations", "digest")
    return numbers if isinstance(numbers, dict) and all(key in numbers for key in needed) else None
