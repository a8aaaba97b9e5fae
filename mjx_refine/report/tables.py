"""The report's tables: objects, parameters, and what no clip could tell."""

from __future__ import annotations

import dataclasses
import math

from mjx_refine.observation import Observation
from mjx_refine.report.contours import colour, pale
from mjx_refine.report.numbers import mask_ids, object_ious
from mjx_refine.search.result import ParameterRow, RefineResult

_DIMENSIONLESS = "1"

_MEANINGS = {
    "clearance": "clearance: height of the lowest point above the floor at the first frame",
    "half_height": "half_height: half of the cylinder's height; refined.yaml holds the full height",
    "yaw": "yaw: turn about the vertical, from the sample's orientation",
    "tilt": "tilt: turn about a horizontal axis, from the sample's orientation",
    "spin": "spin: angular velocity in the world frame; refined.yaml holds the body frame's",
    "damping": "damping: its magnitude; refined.yaml holds it negative",
}


@dataclasses.dataclass(frozen=True)
class Row:
    """One parameter as text."""

    name: str
    unit: str
    before: str
    after: str
    interval: str
    change: str
    determined: bool
    note: str


@dataclasses.dataclass(frozen=True)
class ObjectRow:
    """One object as text, with the colours of its outlines (CSS)."""

    name: str
    shape: str
    mask: str
    iou: str
    poor: bool
    seen: str
    simulated: str


def number(value: float | None, digits: int = 4) -> str:
    """A number with so many significant digits, or a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 2}e}".replace("-", "−")
    text = f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return text.replace("-", "−")


def fixed(value: float) -> str:
    """A score with three decimals, or a dash where there is none."""
    return f"{value:.3f}".replace("-", "−") if math.isfinite(value) else "–"


def parameter_groups(result: RefineResult) -> list[tuple[str, list[Row]]]:
    """(owner, rows): the parameters of each object and of the world; names keep what follows the owner's."""
    groups: dict[str, list[Row]] = {}
    owners = sorted(result.scene.names, key=len, reverse=True)
    for row in result.parameters:
        owner = next((name for name in owners if row.name.startswith(f"{name}.")), "")
        groups.setdefault(owner, []).append(_row(row, owner))
    ordered = [name for name in (*result.scene.names, "") if name in groups]
    return [(name or "camera and gravity", groups[name]) for name in ordered]


def meanings(result: RefineResult) -> list[str]:
    """What names in the table mean that the scene's file does not have."""
    parts = {part for row in result.parameters for part in row.name.split(".")}
    return [text for part, text in _MEANINGS.items() if part in parts]


def object_rows(result: RefineResult, observation: Observation) -> list[ObjectRow]:
    """A row an object."""
    rows = []
    for k, (body, mask, iou) in enumerate(
        zip(result.scene.objects, mask_ids(result, observation), object_ious(result), strict=True)
    ):
        shown = "none" if mask is None else str(mask)
        poor = math.isfinite(iou) and iou < 0.7
        rows.append(ObjectRow(body.name, body.shape, shown, fixed(iou), poor, _css(pale(k)), _css(colour(k))))
    return rows


def _row(row: ParameterRow, owner: str) -> Row:
    name = row.name[len(owner) + 1 :] if owner else row.name
    change = row.after - row.before
    same = abs(change) <= 1e-9 * max(1.0, abs(row.before))
    sign = "" if same else "+" if change > 0 else ""
    return Row(
        name=name,
        unit="" if row.unit == _DIMENSIONLESS else row.unit.replace("^2", "²"),
        before=_with_degrees(row.before, row.unit),
        after=_with_degrees(row.after, row.unit),
        interval="" if row.low is None or row.high is None else f"{number(row.low)} … {number(row.high)}",
        change="" if same else sign + _with_degrees(change, row.unit, digits=3),
        determined=row.determined,
        note=row.note,
    )


def _with_degrees(value: float, unit: str, digits: int = 4) -> str:
    text = number(value, digits)
    if unit == "rad" and math.isfinite(value):
        text += f" ({number(round(math.degrees(value), 2), digits)}°)"
    return text


def _css(shade: tuple[int, int, int]) -> str:
    return "rgb({},{},{})".format(*shade)
