"""Diagnosis: where a simulation and a clip part, which unmodelled effect parts them, and how far it closes the gap."""

from mjx_refine.diagnosis.diagnose import diagnose
from mjx_refine.diagnosis.joint.videos import diagnose_clips
from mjx_refine.diagnosis.poses import Poses, load_poses, make_poses
from mjx_refine.diagnosis.recorded import diagnose_poses
from mjx_refine.diagnosis.result import CHANNELS, ClipGap, Diagnosis, Gap, Place, Ranked, Value, Verdict

__all__ = [
    "CHANNELS",
    "ClipGap",
    "Diagnosis",
    "Gap",
    "Place",
    "Poses",
    "Ranked",
    "Value",
    "Verdict",
    "diagnose",
    "diagnose_clips",
    "diagnose_poses",
    "load_poses",
    "make_poses",
]
