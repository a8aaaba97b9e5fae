"""A diagnosis in a few lines, for a terminal."""

from __future__ import annotations

from mjx_refine.diagnosis.result import NONE, UNKNOWN, Diagnosis, Place
from mjx_refine.report.diagnosis_tables import CandidateRow, ValueText, candidate_rows, closed_between, percent
from mjx_refine.report.tables import number


def in_words(diagnosis: Diagnosis) -> list[str]:
    """What was answered, how sure that is, the numbers of what was named, where the gap is, and how much of it closes.

    Args:
      diagnosis: what was found.
    """
    verdict = diagnosis.verdict
    lines = [f"{verdict.sentence} (probability {verdict.probability:.2f})"]
    lines += [_named(row) for row in candidate_rows(diagnosis) if row.chosen]
    if verdict.effects != NONE and diagnosis.where:
        lines.append(_where(diagnosis, diagnosis.places[0]))
    if verdict.effects == UNKNOWN and diagnosis.residual:
        lines.append(f"  the gap: {diagnosis.residual}")
    return [*lines, _gap(diagnosis)]


def _named(row: CandidateRow) -> str:
    values = ", ".join(map(_value, row.values)) + (f", and {row.more} more" if row.more else "")
    return f"  {row.effect}{f' of {row.target}' if row.target else ''}: {values}"


def _value(value: ValueText) -> str:
    interval = f" ({value.interval})" if value.interval else ""
    return f"{value.name} {value.value}{f' {value.unit}' if value.unit else ''}{interval}"


def _where(diagnosis: Diagnosis, place: Place) -> str:
    clip = "" if place.clip is None else f" of {diagnosis.clips[place.clip].source}"
    object_or_view = place.object or "the whole view"
    return (
        f"  where: {object_or_view}, frames {place.frames[0]}–{place.frames[1]}{clip}, {place.phase}, {place.channel} "
        f"({percent(place.share)} of the gap)"
    )


def _gap(diagnosis: Diagnosis) -> str:
    gap = diagnosis.gap
    floor = f"noise alone {number(gap.noise_floor, 3)}; {gap.held_out}"
    if not diagnosis.added:
        return f"  held-out gap: {number(gap.before, 3)}, {floor}"
    interval = f" ({between})" if (between := closed_between(gap)) else ""
    return f"  held-out gap: {number(gap.before, 3)} → {number(gap.after, 3)}, {percent(gap.closed)} closed{interval}, {floor}"
