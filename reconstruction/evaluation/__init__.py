"""The ruler: a scene bundle and the truth in, the metrics of CONTRACT section 4 out, per stage where that is kept."""

from reconstruction.evaluation.evaluate import Evaluation, evaluate_scene
from reconstruction.evaluation.ground_truth import GroundTruth, TrueEntity
from reconstruction.evaluation.stage_results import StageResults

__all__ = ["Evaluation", "GroundTruth", "StageResults", "TrueEntity", "evaluate_scene"]
