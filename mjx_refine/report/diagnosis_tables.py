"""A diagnosis' numbers as text for its page."""

from __future__ import annotations

import dataclasses
import math

from mjx_refine.diagnosis.result import Diagnosis, Gap, Ranked, Value
from mjx_refine.report.tables import fixed, number

_MOST_VALUES = 8


def percent(value: float) -> str:
    """A share as per cent, never a certainty that was rounded up; a dash where there is none."""
    if not math.isfinite(value):
        return "–"
    if 0.995 <= value < 1.0:
        return "> 99 %"
    if 0.0 < value < 0.005:
        return "< 1 %"
    return f"{100 * value:.0f} %".replace("-", "−")


def closed_between(gap: Gap) -> str:
    """The interval of how much of the gap is closed; empty where it is not known."""
    known = math.isfinite(gap.closed_low) and math.isfinite(gap.closed_high)
    return f"{percent(gap.closed_low)} … {percent(gap.closed_high)}" if known else ""


def width(value: float) -> str:
    """A share as a CSS width."""
    return f"{100 * min(max(value, 0.0), 1.0):.1f}%" if math.isfinite(value) else "0%"


@dataclasses.dataclass(frozen=True)
class GapTile:
    """One number of the gap, with what it was before."""

    name: str
    value: str
    unit: str
    was: str
    better: bool


def gap_tiles(gap: Gap, changed: bool) -> list[GapTile]:
    """The numbers at the top of the page; ``changed``: whether the diagnosed scene is another than the base model's."""
    floor = f"noise floor {number(gap.noise_floor, 3)}"
    if math.isfinite(gap.position_before) or math.isfinite(gap.rotation_before):
        return _pose_tiles(gap, changed, floor)
    if not changed:
        return [
            GapTile("Gap, base model", number(gap.before, 3), "", floor, True),
            GapTile("IoU, whole clip", fixed(gap.iou_before), "", "base model", True),
            GapTile("End-point error, whole clip", fixed(gap.epe_before), "px", "base model", True),
        ]
    interval = closed_between(gap)
    was = f"90 % interval {interval}" if interval else ""
    return [
        GapTile("Gap closed", percent(gap.closed), "", was, not gap.closed < 0),
        GapTile(
            "Gap", number(gap.after, 3), "", f"before {number(gap.before, 3)}, {floor}", not gap.after > gap.before
        ),
        GapTile(
            "IoU, whole clip",
            fixed(gap.iou_after),
            "",
            f"before {fixed(gap.iou_before)}",
            not gap.iou_after < gap.iou_before,
        ),
        GapTile(
            "End-point error, whole clip",
            fixed(gap.epe_after),
            "px",
            f"before {fixed(gap.epe_before)}",
            not gap.epe_after > gap.epe_before,
        ),
    ]


def _pose_tiles(gap: Gap, changed: bool, floor: str) -> list[GapTile]:
    """The same where poses were measured: errors in millimetres and degrees instead of pictures' scores."""
    interval = f"90 % interval {percent(gap.closed_low)} … {percent(gap.closed_high)}"
    tiles = [GapTile("Gap closed", percent(gap.closed), "", interval, not gap.closed < 0)] if changed else []
    was = f"before {number(gap.before, 3)}, {floor}" if changed else floor
    name = "Gap" if changed else "Gap, base model"
    tiles.append(GapTile(name, number(gap.after, 3), "", was, not gap.after > gap.before))
    for kind, before, after, factor, unit in (
        ("Position", gap.position_before, gap.position_after, 1e3, "mm"),
        ("Rotation", gap.rotation_before, gap.rotation_after, math.degrees(1.0), "degrees"),
    ):
        if math.isfinite(before):
            was = f"before {number(factor * before, 3)} {unit}" if changed else "base model"
            tiles.append(GapTile(f"{kind} error", number(factor * after, 3), unit, was, not after > before))
    return tiles


@dataclasses.dataclass(frozen=True)
class ValueText:
    """One fitted parameter as text."""

    name: str
    value: str
    interval: str
    unit: str


@dataclasses.dataclass(frozen=True)
class CandidateRow:
    """One candidate as text; ``chosen``: it is in the verdict."""

    effect: str
    target: str | None
    sentence: str
    probability: float
    evidence: str
    values: list[ValueText]
    more: int
    gap_after: str
    closed: str
    chosen: bool


def candidate_rows(diagnosis: Diagnosis) -> list[CandidateRow]:
    """A row a candidate, in the diagnosis' order; an effect of the verdict is marked at its first row alone."""
    rows, marked = [], set()
    for one in diagnosis.candidates:
        chosen = one.effect in diagnosis.verdict.effects and one.effect not in marked
        if chosen:
            marked.add(one.effect)
        rows.append(_row(one, chosen))
    return rows


@dataclasses.dataclass(frozen=True)
class ClipRow:
    """One of several clips as text."""

    source: str
    role: str
    before: str
    after: str
    floor: str
    position: str
    rotation: str


def clip_rows(diagnosis: Diagnosis) -> list[ClipRow]:
    """A row a clip of a set-up, in the call's order."""

    def both(before: float, after: float, factor: float) -> str:
        if not math.isfinite(before):
            return "–"
        return f"{number(factor * before, 3)} → {number(factor * after, 3)}"

    return [
        ClipRow(
            source=one.source,
            role="fitted" if one.fitted else "judged",
            before=number(one.before, 3),
            after=number(one.after, 3),
            floor=number(one.noise_floor, 3),
            position=both(one.position_before, one.position_after, 1e3),
            rotation=both(one.rotation_before, one.rotation_after, math.degrees(1.0)),
        )
        for one in diagnosis.clips
    ]


def _row(one: Ranked, chosen: bool) -> CandidateRow:
    values = [_value(name, value) for name, value in one.parameters.items()]
    more = len(values) - _MOST_VALUES if len(values) > _MOST_VALUES + 1 else 0
    return CandidateRow(
        effect=one.effect,
        target=one.target,
        sentence=one.sentence,
        probability=one.probability,
        evidence=f"{one.evidence:+.1f}".replace("-", "−") if math.isfinite(one.evidence) else "–",
        values=values[:_MOST_VALUES] if more else values,
        more=more,
        gap_after=number(one.gap_after, 3),
        closed=percent(one.closed),
        chosen=chosen,
    )


def _value(name: str, value: Value) -> ValueText:
    known = math.isfinite(value.low) and math.isfinite(value.high)
    return ValueText(
        name=name,
        value=number(value.value, 3),
        interval=f"{number(value.low, 3)} … {number(value.high, 3)}" if known else "",
        unit="" if value.unit == "1" else value.unit.replace("^2", "²").replace("^3", "³"),
    )
