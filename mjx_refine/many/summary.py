"""``summary.csv``: a row a job."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable
from pathlib import Path

from mjx_refine.files import write_text
from mjx_refine.many.jobs import SUMMARY
from mjx_refine.many.outcome import FIELDS, Outcome


def summary_csv(outcomes: Iterable[Outcome]) -> str:
    """A row a job, with a header of ``Outcome``'s fields; empty where there is no number."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(FIELDS)
    writer.writerows(dataclasses.astuple(outcome) for outcome in outcomes)
    return stream.getvalue()


def write_summary(out: Path, outcomes: Iterable[Outcome]) -> Path:
    """Writes ``summary.csv`` in ``out``, whole or not at all."""
    return write_text(out / SUMMARY, summary_csv(outcomes))
