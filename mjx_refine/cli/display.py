"""A live line on a terminal: where the search is, how good, how long still. Silent elsewhere."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from mjx_refine.search.progress import Progress, Step

_PHASES = {"land": "landing (least squares)", "search": "searching (CMA-ES)"}


class TerminalProgress(Progress):
    """Shows a refinement's steps with rich, on stderr."""

    def __init__(self):
        self.console = Console(stderr=True)
        self.bar: Bar | None = None
        self.task = None

    def message(self, text: str) -> None:
        """Prints a line above the bar."""
        self.console.print(text, style="dim", highlight=False, markup=False)

    def step(self, step: Step) -> None:
        """Moves the bar."""
        if self.bar is None:
            self.bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                TextColumn("{task.completed}/{task.total} rollouts"),
                TextColumn("IoU {task.fields[iou]:.3f}  EPE {task.fields[epe]:.3f} px"),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=self.console,
                transient=True,
            )
            self.task = self.bar.add_task("", total=step.budget, iou=0.0, epe=0.0)
            self.bar.start()
        self.bar.update(
            self.task,  # type: ignore[arg-type]
            description=_PHASES.get(step.phase, step.phase),
            completed=step.evaluations,
            iou=step.iou,
            epe=step.epe,
        )

    def close(self) -> None:
        """Removes the bar."""
        if self.bar is not None:
            self.bar.stop()


def display() -> Progress:
    """A live display where stderr is a terminal, else one that shows nothing."""
    return TerminalProgress() if sys.stderr.isatty() else Progress()
