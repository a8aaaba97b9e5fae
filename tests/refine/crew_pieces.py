"""A clip that is quickly made and pieces of work on it, for tests of who does them; processes import this."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from mjx_refine.diagnosis.crew import crew_of
from mjx_refine.diagnosis.store import Store


class Plain:
    """What a crew asks of a clip."""

    def __init__(self, facts: str = "plain"):
        self.facts, self.settled, self.rollouts, self.store = facts, 0.0, 0.0, Store()

    def state(self) -> str:
        return f"{self.facts} {self.settled}"

    def again(self) -> Any:
        return Again(self.facts)

    def warm(self) -> None:
        """Has nothing to compile."""


@dataclasses.dataclass
class Again:
    """Makes the clip anew."""

    facts: str

    def __call__(self, threads: int) -> Plain:
        return Plain(self.facts)


def elsewhere() -> bool:
    """Whether this is one of the other processes."""
    return multiprocessing.parent_process() is not None


def scaled(clip: Any, x: float) -> tuple[float, bool]:
    """What depends on the clip's state, what was kept, and who did it."""
    time.sleep(0.02)
    clip.rollouts += x
    kept = clip.store.recall(f"{x:g}")
    if kept is None:
        kept = {"x": np.array(clip.settled * x)}
        clip.store.keep(f"{x:g}", kept)
    return float(kept["x"]), elsewhere()


def ends(clip: Any, x: float) -> tuple[float, bool]:
    """Ends each process but the first."""
    if elsewhere():
        os.kill(os.getpid(), signal.SIGKILL)
    return scaled(clip, x)


def wrong(clip: Any, x: float) -> None:
    """Fails."""
    raise ZeroDivisionError(x)


def waits(clip: Any, folder: Path) -> None:
    """Says in a file who it is, and never ends."""
    (folder / f"{os.getpid()}").touch()
    time.sleep(600)


def main() -> None:
    """Waits for ever, in several processes, without a guard against being imported."""
    with crew_of(3) as crew:
        crew.each(Plain(), waits, [(Path(sys.argv[1]),)] * 3)
