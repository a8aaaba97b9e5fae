"""Synthetic training data as Δynamics (CVPR 2026) has it: random scenes, simulated, filtered, drawn, written as shards."""

from mjx_refine.generate.make import replayed
from mjx_refine.generate.options import HELD_OUT, SPLITS, GenerateOptions
from mjx_refine.generate.record import Record, Seen
from mjx_refine.generate.run import GenerateProgress, Summary, generate_scenes
from mjx_refine.generate.shards import read_records, unpack

__all__ = [
    "HELD_OUT",
    "SPLITS",
    "GenerateOptions",
    "GenerateProgress",
    "Record",
    "Seen",
    "Summary",
    "generate_scenes",
    "read_records",
    "replayed",
    "unpack",
]
