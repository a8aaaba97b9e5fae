"""Scores of scenes against clips and against true scenes: one scene, or a folder of predictions."""

from mjx_refine.evaluate.folder import Evaluation, Row, evaluate_folder
from mjx_refine.evaluate.samples import METRICS, Judged, best_of, judge_samples, paired
from mjx_refine.evaluate.scores import compare_scenes, evaluate_scene

__all__ = [
    "METRICS",
    "Evaluation",
    "Judged",
    "Row",
    "best_of",
    "compare_scenes",
    "evaluate_folder",
    "evaluate_scene",
    "judge_samples",
    "paired",
]
