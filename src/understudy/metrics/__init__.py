"""How good is a method? Predicted people against the truth.

`evaluate(predicted_frames, truth)` gives an `Evaluation`; `metric_values(evaluation)` its numbers by the keys of
`METRICS`, where each has its unit and definition.
To pool recordings: `summarise(Observations.pooled([observe(...), ...]))`.
"""

from understudy.metrics.angles import PalmMetrics
from understudy.metrics.calibration import Calibration
from understudy.metrics.definitions import CLASS_DEFINITIONS, DEFINITION, METRICS, MetricDefinition, metric_values
from understudy.metrics.evaluation import CLASSES, Evaluation, evaluate, summarise
from understudy.metrics.joints import PCK_THRESHOLDS_M, JointMetrics
from understudy.metrics.matching import DEFAULT_RULE, MatchRule, match_people
from understudy.metrics.observations import Counts, Observations, observe

__all__ = [
    "CLASSES",
    "CLASS_DEFINITIONS",
    "DEFAULT_RULE",
    "DEFINITION",
    "METRICS",
    "PCK_THRESHOLDS_M",
    "Calibration",
    "Counts",
    "Evaluation",
    "JointMetrics",
    "MatchRule",
    "MetricDefinition",
    "Observations",
    "PalmMetrics",
    "evaluate",
    "match_people",
    "metric_values",
    "observe",
    "summarise",
]
