"""``diagnosis.json``: the numbers of a diagnosis, for programs."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

from mjx_fitness import UNMATCHED

from mjx_refine.diagnosis.result import CHANNELS, ClipGap, Diagnosis, Gap, Place, Ranked
from mjx_refine.report.numbers import plain

FORMAT = 1
_DIGITS = 6


def diagnosis_numbers(diagnosis: Diagnosis, call: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Everything in ``diagnosis`` but its scenes, as plain dicts, lists and numbers; what is not finite becomes None.

    Args:
      diagnosis: what to write down.
      call: what was asked for (files, seed, effects withheld, fingerprint); stands under ``call``.
    """
    verdict = diagnosis.verdict
    numbers: dict[str, Any] = {
        "format": FORMAT,
        "verdict": {
            "effects": verdict.effects,
            "probability": _rounded(verdict.probability, 4),
            "indistinguishable": verdict.indistinguishable,
            "sentence": verdict.sentence,
            "experiment": verdict.experiment,
        },
        "gap": _gap(diagnosis.gap),
        "where": [{**_place(place), "share": _rounded(max(0.0, place.share), 4)} for place in diagnosis.places],
        "candidates": [_candidate(one) for one in diagnosis.candidates],
        "residual": {"description": diagnosis.residual, "remaining": diagnosis.remaining},
        "objects": [
            {"name": name, "mask_id": None if mask == UNMATCHED else mask}
            for name, mask in zip(diagnosis.base.names, diagnosis.matching, strict=True)
        ],
        "map": {
            "unit": "root mean square misfit, noise widths; a row an object, a column a frame",
            "before": _significant(diagnosis.map_before.tolist(), 3),
            "after": _significant(diagnosis.map_after.tolist(), 3),
            "channels": [[CHANNELS[k] if 0 <= k < len(CHANNELS) else None for k in row] for row in diagnosis.channels],
        },
        "notes": diagnosis.notes,
        "signs": {name: _significant(value, 4) for name, value in diagnosis.signs.items()},
        "seconds": _rounded(diagnosis.seconds, 2),
        "rollouts": diagnosis.rollouts,
    }
    if diagnosis.clips:
        numbers["clips"] = [_clip(one) for one in diagnosis.clips]
    if call is not None:
        numbers["call"] = dict(call)
    return plain(numbers)


def diagnosis_json(diagnosis: Diagnosis, call: Mapping[str, Any] | None = None) -> str:
    """``diagnosis_numbers`` as strict JSON."""
    return json.dumps(diagnosis_numbers(diagnosis, call), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _place(place: Place) -> dict[str, Any]:
    """Without the clip where there is but one."""
    return {name: value for name, value in dataclasses.asdict(place).items() if name != "clip" or value is not None}


def _clip(one: ClipGap) -> dict[str, Any]:
    """What is not known of a clip is left out."""
    values = dataclasses.asdict(one)
    numbers = {k: _significant(v, _DIGITS) for k, v in values.items() if isinstance(v, float) and math.isfinite(v)}
    return {"source": one.source, "role": "fitted" if one.fitted else "judged", **numbers}


def _gap(gap: Gap) -> dict[str, Any]:
    values = {
        name: _significant(value, _DIGITS) if isinstance(value, float) else value
        for name, value in dataclasses.asdict(gap).items()
        # Errors in metres and radians are there where poses were measured, and only there.
        if not (name.startswith(("position_", "rotation_")) and math.isnan(value))
    }
    values["closed"] = _rounded(gap.closed, 4)
    values["closed_interval"] = [_rounded(values.pop(name), 4) for name in ("closed_low", "closed_high")]
    return values


def _candidate(one: Ranked) -> dict[str, Any]:
    return {
        "effect": one.effect,
        "target": one.target,
        "probability": _rounded(one.probability, 4),
        "evidence": _rounded(one.evidence, 2),
        "parameters": {
            name: {
                "value": _significant(value.value, _DIGITS),
                "low": _significant(value.low, _DIGITS),
                "high": _significant(value.high, _DIGITS),
                "unit": value.unit,
            }
            for name, value in one.parameters.items()
        },
        "gap_after": _significant(one.gap_after, _DIGITS),
        "closed": _rounded(one.closed, 4),
        "sentence": one.sentence,
    }


def _rounded(value: float, decimals: int) -> float:
    """To so many decimals; infinities and NaN as they are."""
    return round(float(value), decimals)


def _significant(value: Any, digits: int) -> Any:
    """Numbers to so many significant digits, at any depth of lists."""
    if isinstance(value, list):
        return [_significant(inner, digits) for inner in value]
    value = float(value)
    return float(f"{value:.{digits - 1}e}") if math.isfinite(value) else value
