"""Masks, flow and their score: knows images, nothing of scenes or simulation."""

from mjx_fitness.matching import match_costs, match_instances
from mjx_fitness.pictures import UNMATCHED, picture_sums, score_pictures
from mjx_fitness.sums import Scores, Sums, Weights, scores_from_sums

__all__ = [
    "UNMATCHED",
    "Scores",
    "Sums",
    "Weights",
    "match_costs",
    "match_instances",
    "picture_sums",
    "score_pictures",
    "scores_from_sums",
]
