"""A scene that is not its clip's: what hardly overlaps the masks with all numbers refitted cannot say what is missing."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from mjx_refine.diagnosis.answer.verdict import AT_WORK_OF_A_VIDEO, LIKELY_OF_A_VIDEO
from mjx_refine.diagnosis.fits.fit import Fit
from mjx_refine.diagnosis.result import UNKNOWN, Diagnosis, Verdict

MATCHES = 0.5
"""Overlap (IoU) that the refitted base model, or the diagnosed scene, must reach: on 115 clips of seeds 20 to 27 of the withheld
exams one of them reaches 0.76 at least; another clip's scenes, with fewer objects, reached 0.37 and 0.38."""

FAR = 6.0
"""How far the ordinary numbers may move from the given scene's, root mean square in prior widths: of 15 pairs of a scene and
another clip that it overlaps, of seeds 29 and 30 of the withheld exams, the base models' went 8.7 to 16; those of 14 scenes and
their own clips 0.5 to 4.2, of a language model's samples for the example's clip, which nobody had refined, 2.9 to 3.8."""

AT_ONCE = 10.0
"""How far they may move in the base model's first fit, before any effect is looked for: of 69 clips of seeds 34 to 36, most of
them with an effect, 7.4 at most; of 25 pairs of a scene and another clip that it overlaps more than that in eleven."""


def another(base: Fit) -> bool:
    """Whether the base model's first fit moved so far that the scene is another clip's, whatever may be missing."""
    return moved_by([base]) > AT_ONCE


def moved_by(fits: Sequence[Fit]) -> float:
    """How far ordinary numbers moved from the given scene's in the fit that moves them least; root mean square [prior widths]."""
    return min(float(np.sqrt(np.mean(fit.z[: fit.hypothesis.space.dimension] ** 2))) for fit in fits)


def matched(found: Diagnosis, moved: float) -> Diagnosis:
    """The diagnosis; or, where neither scene replays the clip, or only another scene does, that nothing can be told, and why.

    Args:
      found: the diagnosis.
      moved: how far the ordinary numbers moved from the given scene's [prior widths].
    """
    gap = found.gap
    reached = max(gap.iou_before, gap.iou_after)
    if reached < MATCHES:
        why = (
            f"refitted, the scene overlaps the clip's masks with an IoU of {reached:.2f} (at least {MATCHES:g} is expected of a "
            "scene of this clip)"
        )
    elif moved > FAR:
        why = (
            f"to replay the clip, the scene's own numbers had to move by {moved:.1f} times what a refined scene may be off by "
            f"(root mean square; at most {FAR:g} is expected of a scene of this clip)"
        )
    else:
        return found
    text = f"Cannot tell: {why}, so what it lacks cannot be told from its being another's."
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
