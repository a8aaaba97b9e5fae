"""Test clips made by another engine than the one that refines them, and rough guesses of their scenes.

Motion and pictures come from PyBullet, optical flow from OpenCV, so that a refinement never sees its own simulator
or its own rasteriser. Needs the `bench` extra.
"""

from benchmarks.clips.clip import Clip, make_clip
from benchmarks.clips.samples import SampleSet, rough_samples

__all__ = ["Clip", "SampleSet", "make_clip", "rough_samples"]
