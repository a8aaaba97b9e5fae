"""Many clips from the command line: one live line, a table, and an exit status for the whole."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mjx_refine.errors import InputError

if TYPE_CHECKING:
    from mjx_refine.many import Many, ManyProgress, Outcome

ENGINES = ("processes", "ray")
WIDTH = 120
"""Of the table where standard output is no terminal."""


def refine_many_command(
    init: Sequence[Path], video: Sequence[Path], jobs: Path | None, out: Path, options: dict, **how
) -> None:
    """Refines many clips, prints the table and ends with the exit status of the whole.

    Args:
      init, video: files, a clip each; or
      jobs: the jobs file.
      out: folder of all.
      options: of ``Options``.
      how: ``workers``, ``resume``, ``engine``, ``address`` of ``refine_many``.
    """
    from mjx_refine.files import writable_directory

    writable_directory(out)

    # Importing JAX takes seconds.
    from mjx_refine.many import jobs_of_pairs, load_jobs, refine_many
    from mjx_refine.search import Options

    todo = load_jobs(jobs) if jobs is not None else jobs_of_pairs(init, video)
    many = refine_many(todo, Options(**options), out=out, progress=many_display(), **how)
    print_table(many)
    if many.status == 2:
        reasons = [outcome.reason for outcome in many.outcomes]
        raise InputError(reasons[0] + (f" (and {len(reasons) - 1} more jobs with errors)" if reasons[1:] else ""))
    if many.status:
        raise click.exceptions.Exit(many.status)


def print_table(many: Many) -> None:
    """On standard output: a row a job, a line for each that has a reason to tell, how many there are of each status."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    for title in ("clip", "status"):
        table.add_column(title, overflow="fold")
    for title in ("IoU", "EPE px", "fitness"):
        table.add_column(title, justify="right", no_wrap=True)
    for title in ("rollouts", "s"):
        table.add_column(title, justify="right")
    for outcome in many.outcomes:
        table.add_row(*(Text(_printable(cell)) for cell in _cells(outcome)))
    console = Console(width=None if sys.stdout.isatty() else WIDTH, highlight=False)
    console.print(table)
    for outcome in many.outcomes:
        if outcome.reason:
            click.echo(_printable(f"{outcome.name}: {outcome.reason}"))
    counts: dict[str, int] = {}
    for outcome in many.outcomes:
        counts[outcome.status] = counts.get(outcome.status, 0) + 1
    click.echo(f"{', '.join(f'{n} {status}' for status, n in counts.items())}; {many.out / 'summary.csv'}")


def _cells(outcome: Outcome) -> list[str]:
    def change(before: float | None, after: float | None) -> str:
        return "" if before is None or after is None else f"{before:.3f} -> {after:.3f}"

    return [
        outcome.name,
        outcome.status,
        change(outcome.iou_before, outcome.iou_after),
        change(outcome.epe_before, outcome.epe_after),
        change(outcome.fitness_before, outcome.fitness_after),
        "" if outcome.evaluations is None else str(outcome.evaluations),
        "" if outcome.seconds is None else f"{outcome.seconds:.0f}",
    ]


def _printable(text: str) -> str:
    """A name or reason without control characters, which a terminal would obey."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def many_display() -> ManyProgress:
    """One live line where stderr is a terminal, else a display that shows nothing."""
    from mjx_refine.many import ManyProgress

    return _terminal_line() if sys.stderr.isatty() else ManyProgress()


def _terminal_line() -> ManyProgress:
    import time

    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from mjx_refine.many import ManyProgress

    class Line(ManyProgress):
        """How many jobs are done, which are at work, how long still."""

        def __init__(self):
            self.live = Live(console=Console(stderr=True), transient=True, refresh_per_second=2)
            self.live.start()
            self.began = time.monotonic()

        def update(self, finished: int, total: int, part: float, running: tuple[str, ...]) -> None:
            line = told(finished, total, part, running, time.monotonic() - self.began)
            self.live.update(Text(_printable(line), no_wrap=True, overflow="ellipsis"))

        def close(self) -> None:
            self.live.stop()

    return Line()


def told(finished: int, total: int, part: float, running: tuple[str, ...], seconds: float) -> str:
    """The line: ``3/16 clips, 0:01:10, about 0:05:00 left; at work: a, b``."""
    left = f"about {_clock(seconds * (1 - part) / part)} left" if part > 0.01 and seconds > 5 else "time left unknown"
    return f"{finished}/{total} clips, {_clock(seconds)}, {left}; at work: {', '.join(running) or 'nothing yet'}"


def _clock(seconds: float) -> str:
    whole = int(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
