"""A scene that is not its clip's: what hardly overlaps the masks with all numbers refitted cannot say what is missing."""

from __future__ import annotations

import dataclasses

from mjx_refine.diagnosis.result import UNKNOWN, Diagnosis, Verdict
from mjx_refine.diagnosis.verdict import AT_WORK_OF_A_VIDEO, LIKELY_OF_A_VIDEO

MATCHES = 0.5
"""Overlap (IoU) that the refitted base model, or the diagnosed scene, must reach: on 115 clips of seeds 20 to 27 of the withheld
exams one of them reaches 0.76 at least; another clip's scenes, with fewer objects, reached 0.37 and 0.38."""


def matched(found: Diagnosis) -> Diagnosis:
    """The diagnosis; or, where neither scene replays the clip, that nothing can be told, and why."""
    gap = found.gap
    reached = max(gap.iou_before, gap.iou_after)
    if not reached < MATCHES:
        return found
    text = (
        f"Cannot tell: refitted, the scene overlaps the clip's masks with an IoU of {reached:.2f} (at least {MATCHES:g} is "
        "expected of a scene of this clip), so what it lacks cannot be told from its being another's."
    )
    verdict = Verdict(
        UNKNOWN, LIKELY_OF_A_VIDEO, (), text, "Check objects and masks, and refine the scene with this clip first."
    )
    at_work = AT_WORK_OF_A_VIDEO["unknown"]
    return dataclasses.replace(
        found,
        verdict=verdict,
        gap=dataclasses.replace(
            gap,
            after=gap.before,
            closed=0.0,
            closed_low=0.0,
            closed_high=0.0,
            iou_after=gap.iou_before,
            epe_after=gap.epe_before,
        ),
        candidates=tuple(
            dataclasses.replace(one, probability=min(one.probability, at_work)) for one in found.candidates
        ),
        remaining=found.residual,
        scene=found.base,
        map_after=found.map_before,
    )
