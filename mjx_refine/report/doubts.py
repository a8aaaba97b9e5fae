"""What should keep a reader from trusting a refinement: in its report, in ``result.json`` and on the command line."""

from __future__ import annotations

import numpy as np
from mjx_fitness import UNMATCHED

from mjx_refine.observation import Observation
from mjx_refine.search.result import RefineResult

POOR = 0.7
"""IoU below which a result is called poor."""


def warnings(result: RefineResult, observation: Observation) -> list[str]:
    """What should keep a reader from trusting the result."""
    before, after = result.init.scores, result.refined.scores
    found = []
    iou = float(after.iou[0])
    if iou < POOR:
        found.append(
            f"The result is poor: IoU {iou:.2f} is below {POOR}. Look at the frames in the report for what does not fit: a wrong "
            "shape, number of objects or mask, or something that the model lacks. More iterations or samples may help."
        )
    if float(after.first_frame_iou[0]) < float(before.first_frame_iou[0]) - 0.01:
        found.append(
            f"The first frame fits worse than before: IoU {float(before.first_frame_iou[0]):.3f} became "
            f"{float(after.first_frame_iou[0]):.3f}."
        )
    if not np.isfinite(result.refined.poses).all():
        first = int(np.argmax(~np.isfinite(result.refined.poses).all((1, 2))))
        found.append(f"The simulation diverges at frame {first}.")
    if not np.isfinite(observation.flow).all(-1).any():
        found.append("The clip's flow is measured nowhere: an end-point error of 0 says nothing.")
    lost = [name for name, mask in zip(result.scene.names, result.matching, strict=True) if mask == UNMATCHED]
    if lost:
        found.append(
            f"No mask was left for {', '.join(lost)}: nothing in the clip holds {'it' if len(lost) == 1 else 'them'}."
        )
    unseen = sorted(set(observation.mask_ids()) - set(result.matching))
    if unseen:
        found.append(f"Masks without an object: {', '.join(map(str, unseen))}.")
    return found
