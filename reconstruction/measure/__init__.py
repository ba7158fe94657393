"""Evaluate a scene bundle against ground truth: the metrics of CONTRACT sections 4 and 5, and figures per stage."""

from reconstruction.measure.evaluate import Evaluation, evaluate_scene
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.outline_files import load_outlines
from reconstruction.measure.outline_labels import LabelledFrame, Outline, OutlineLabels
from reconstruction.measure.outline_scores import OutlineScores, score_outlines
from reconstruction.measure.stage_results import StageResults

__all__ = [
    "Evaluation",
    "GroundTruth",
    "LabelledFrame",
    "Outline",
    "OutlineLabels",
    "OutlineScores",
    "StageResults",
    "TrueEntity",
    "evaluate_scene",
    "load_outlines",
    "score_outlines",
]
