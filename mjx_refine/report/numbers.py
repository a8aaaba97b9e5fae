"""``result.json``: the numbers of a refinement, for programs."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import numpy as np
from mjx_fitness import UNMATCHED

from mjx_refine.observation import Observation
from mjx_refine.report.doubts import warnings
from mjx_refine.search.intervals import CONFIDENCE
from mjx_refine.search.result import ParameterRow, RefineResult, Replay

FORMAT = 1


def result_numbers(result: RefineResult, observation: Observation) -> dict[str, Any]:
    """Everything in ``result`` but pictures, as plain dicts, lists and numbers; what is not finite becomes None."""
    numbers = {
        "format": FORMAT,
        "seed": result.options.seed,
        "backend": result.backend,
        "device": result.device,
        "seconds": dict(result.seconds),
        "init": {"index": result.init_index, **_scores(result.init)},
        "refined": _scores(result.refined),
        "evaluations": result.evaluations,
        "objects": [
            {"name": name, "mask_id": mask, "iou": iou}
            for name, mask, iou in zip(
                result.scene.names, mask_ids(result, observation), object_ious(result), strict=True
            )
        ],
        "scored_by": "C MuJoCo, full resolution",
        "start_index": result.start_index,
        "moved": result.moved,
        "matching": list(result.matching),
        "reason": result.reason,
        "steps": len(result.history),
        "parameters": [_parameter(row) for row in result.parameters],
        "derivatives": _derivatives(result),
        "identification": _identification(result),
        "undetermined": [row.name for row in result.parameters if not row.determined],
        "fixed": [{"name": name, "reason": reason} for name, reason in result.fixed],
        "problems": [{"index": problem.index, "reason": problem.reason} for problem in result.problems],
        "warnings": warnings(result, observation),
        "clip": {"frames": observation.length, "fps": observation.fps, "size": list(observation.size)},
        "options": dataclasses.asdict(result.options),
        "digest": result.digest,
    }
    return plain(numbers)


def _parameter(row: ParameterRow) -> dict:
    values = dataclasses.asdict(row)
    return {"name": values.pop("name"), "value": values.pop("after"), **values}


def _derivatives(result: RefineResult) -> dict | None:
    """Which derivatives could be trusted, and why; None where nobody looked."""
    told = result.derivatives
    return None if told is None else {"method": told.method, "reason": told.reason}


def _identification(result: RefineResult) -> dict | None:
    """How the intervals were found; None where none were."""
    known = result.known
    if known is None:
        return None
    return {
        "confidence": CONFIDENCE,
        "refits": result.options.refits,
        "evaluations": known.evaluations,
        "noise": {"edge": known.edge.tolist(), "flow": known.motion.tolist(), "unit": "px at a picture 480 wide"},
        "free_directions": [{"spread": d.spread, "weights": dict(d.weights)} for d in known.free],
    }


def result_json(result: RefineResult, observation: Observation) -> str:
    """``result_numbers`` as strict JSON."""
    return json.dumps(result_numbers(result, observation), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def mask_ids(result: RefineResult, observation: Observation) -> list[int | None]:
    """For each object its mask's id; None where it has none or the clip has no masks."""
    if observation.masks is None:
        return [None] * len(result.matching)
    return [None if i == UNMATCHED else int(i) for i in result.matching]


def object_ious(result: RefineResult) -> list[float]:
    """IoU of each refined object with its mask; NaN where there is nothing to compare."""
    return [float(v) for v in result.refined.scores.object_iou[0]]


def plain(value: Any) -> Any:
    """Numpy's numbers as Python's, tuples as lists, what is not finite as None; at any depth."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _scores(replay: Replay) -> dict[str, float]:
    scores = replay.scores
    names = ("iou", "first_frame_iou", "epe", "first_frame_epe", "object_epe", "fitness")
    return {name: float(getattr(scores, name)[0]) for name in names}
