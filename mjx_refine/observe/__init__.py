"""Real clips: from a video file to an observation."""

from mjx_refine.observe.clip import ObjectReport, ObserveReport, ObserveResult, observe_clip
from mjx_refine.observe.command import observe_command
from mjx_refine.observe.preview import flow_colours, preview, write_preview, write_result

__all__ = [
    "ObjectReport",
    "ObserveReport",
    "ObserveResult",
    "flow_colours",
    "observe_clip",
    "observe_command",
    "preview",
    "write_preview",
    "write_result",
]
