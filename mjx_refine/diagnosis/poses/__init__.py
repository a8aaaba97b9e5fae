"""Diagnosis from measured poses instead of a video."""

from mjx_refine.diagnosis.poses.data import Poses, load_poses, make_poses
from mjx_refine.diagnosis.poses.diagnose import diagnose_recording

__all__ = ["Poses", "diagnose_recording", "load_poses", "make_poses"]
