"""Every metric with its unit and its definition, for tables and files."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from understudy.metrics.evaluation import CLASSES, Evaluation
from understudy.metrics.joints import JointMetrics


@dataclass(frozen=True)
class MetricDefinition:
    """What a number means."""

    key: str
    """name in files; ends with the unit where there is one"""
    name: str
    unit: str
    """'' for counts and plain numbers"""
    definition: str
    value: Callable[[Evaluation], float]
    """the number, in the unit; NaN where there is nothing to measure"""
    joints: str = ""
    """the class of joints (CLASS_DEFINITIONS) that it is about; '' if it is not about a class"""

    @property
    def label(self) -> str:
        """Name with the class of joints."""
        return f"{self.name}, {self.joints.replace('_', ' ')}" if self.joints else self.name


CLASS_DEFINITIONS: Final = {
    "all": "all joints with truth",
    "visible": "joints inside the image and not hidden from the colour camera",
    "occluded": "joints inside the image, hidden by an object, another person or the body itself",
    "out_of_view": "joints outside the image",
    "in_view": "joints inside the image, visible or occluded",
}

_ALL = "of the joints with truth of all counted true people; those of missed people and those left out are wrong"
_PER_CLASS: Final[tuple[tuple[str, str, str, str, Callable[[JointMetrics], float]], ...]] = (
    ("joints", "joints", "", "Joints with truth of all counted true people.", lambda j: j.n_truth),
    (
        "epe_cm", "EPE", "cm",
        "Mean Euclidean error of the joints that the method gave for matched people. Joints left out are not in it: "
        "read it together with the coverage.",
        lambda j: 100 * j.epe_m,
    ),
    ("epe_median_cm", "median EPE", "cm", "Median of the same errors.", lambda j: 100 * j.epe_median_m),
    (
        "coverage_percent", "coverage", "%",
        "Share of the joints with truth, also of missed people, for which the method gave a position.",
        lambda j: 100 * j.coverage,
    ),
    (
        "pck10_percent", "PCK@10cm", "%", f"Share within 10 cm of the truth, {_ALL}.",
        lambda j: 100 * j.pck,
    ),
    (
        "pck10_given_percent", "PCK@10cm of given", "%",
        "Share of the given joints of matched people within 10 cm (PCK@10cm / coverage): forgives what was left out.",
        lambda j: 100 * j.pck_given,
    ),
    (
        "auc", "AUC", "",
        f"Area under the curve of PCK over its threshold, from 0 to 20 cm, divided by 20 cm (0 to 1); {_ALL}.",
        lambda j: j.auc,
    ),
)  # fmt: skip


def _of_class(
    key: str, name: str, unit: str, text: str, value: Callable[[JointMetrics], float], joints: str
) -> MetricDefinition:
    return MetricDefinition(f"{key}_{joints}", name, unit, text, lambda e: float(value(e.joints[joints])), joints)


def _rate(count: int, total: int, scale: float = 1.0) -> float:
    return scale * count / total if total else math.nan


_PEOPLE: Final = (
    MetricDefinition(
        "frames", "frames", "", "Frames with truth (also with the truth that nobody is there).",
        lambda e: e.counts.frames,
    ),
    MetricDefinition(
        "frames_skipped", "skipped frames", "",
        "Frames with truth that the prediction lists as unreadable; their people are missed.",
        lambda e: e.counts.skipped_frames,
    ),
    MetricDefinition(
        "frames_absent", "absent frames", "", "Frames with truth that the prediction lacks; their people are missed.",
        lambda e: e.counts.absent_frames,
    ),
    MetricDefinition(
        "frames_without_truth", "frames without truth", "", "Predicted frames without truth: ignored.",
        lambda e: e.counts.frames_without_truth,
    ),
    MetricDefinition(
        "people", "people", "", "True people that are counted, once per frame.", lambda e: e.counts.truth_people
    ),
    MetricDefinition(
        "people_uncounted", "uncounted people", "", "True people that are not counted (see matching).",
        lambda e: e.counts.uncounted_people,
    ),
    MetricDefinition(
        "missed", "missed", "", "Counted true people without a matched prediction.", lambda e: e.counts.missed
    ),
    MetricDefinition(
        "missed_percent", "missed", "%", "Missed people / counted true people.",
        lambda e: _rate(e.counts.missed, e.counts.truth_people, 100),
    ),
    MetricDefinition(
        "missed_per_frame", "missed", "1/frame", "Missed people / frames with truth.",
        lambda e: _rate(e.counts.missed, e.counts.frames),
    ),
    MetricDefinition("false", "false", "", "Predicted people that match no true person.", lambda e: e.counts.false),
    MetricDefinition(
        "false_per_frame", "false", "1/frame", "False people / frames with truth.",
        lambda e: _rate(e.counts.false, e.counts.frames),
    ),
    MetricDefinition(
        "failed", "failed", "",
        "Predicted people without 3D joints (or with fewer than a match needs). They match nobody, so that the true "
        "person is missed too; they are not false people.",
        lambda e: e.counts.failed,
    ),
    MetricDefinition(
        "failed_per_frame", "failed", "1/frame", "Failed people / frames with truth.",
        lambda e: _rate(e.counts.failed, e.counts.frames),
    ),
    MetricDefinition(
        "id_switches", "ID switches", "",
        "Times that a true person's predicted id differs from the id at its match before. Means nothing for unrelated "
        "frames.",
        lambda e: e.counts.id_switches,
    ),
)  # fmt: skip

_BODY: Final = (
    MetricDefinition(
        "swapped_percent", "swaps", "%",
        "Share of left-right pairs (shoulders, elbows, wrists, hips, knees, ankles) whose joints are both nearer to "
        "the other side's truth than to their own; of the pairs with both sides given, at least 10 cm apart in truth.",
        lambda e: 100 * e.swapped,
    ),
    MetricDefinition(
        "side_pairs", "side pairs", "", "Left-right pairs that could be judged.", lambda e: e.n_side_pairs
    ),
    MetricDefinition(
        "bone_direction_deg", "bone direction", "deg",
        "Mean angle between a limb bone (upper arm, forearm, thigh, shank) and its truth; bones with both ends given.",
        lambda e: math.degrees(e.bone_direction_rad),
    ),
    MetricDefinition(
        "flexion_deg", "flexion", "deg",
        "Mean absolute error of the angle between the bones at elbows and knees; where all three joints are given.",
        lambda e: math.degrees(e.flexion_rad),
    ),
    MetricDefinition(
        "ece_percent", "ECE", "%",
        "Expected calibration error of the confidence (of being within 10 cm): 10 equal bins, mean of |mean confidence "
        "- share within 10 cm| weighted by joints; given joints of matched people.",
        lambda e: 100 * e.calibration.ece,
    ),
    MetricDefinition(
        "within_1_sigma_percent", "within 1 sigma", "%",
        "Share of the errors of at most sigma_m. By definition 68 %: more means sigma is too large.",
        lambda e: 100 * e.calibration.within_1_sigma,
    ),
    MetricDefinition(
        "within_2_sigma_percent", "within 2 sigma", "%",
        "Share of the errors of at most 2 sigma_m. An isotropic 3D Gaussian has 99.7 %; tails have less.",
        lambda e: 100 * e.calibration.within_2_sigma,
    ),
)  # fmt: skip

_PALMS: Final = (
    MetricDefinition(
        "palms", "palms", "", "Hands in view with a true palm normal, of all counted true people.",
        lambda e: e.palms.n_truth,
    ),
    MetricDefinition(
        "palm_coverage_percent", "palm coverage", "%", "Share of these palms for which the method gave a normal.",
        lambda e: 100 * e.palms.coverage,
    ),
    MetricDefinition(
        "palm_mean_deg", "palm error", "deg", "Mean angle between given normals and the truth.",
        lambda e: math.degrees(e.palms.mean_rad),
    ),
    MetricDefinition(
        "palm_median_deg", "median palm error", "deg", "Median of the same angles.",
        lambda e: math.degrees(e.palms.median_rad),
    ),
    MetricDefinition(
        "palm_within_30_percent", "palms within 30 deg", "%",
        "Share of all these palms within 30 degrees of the truth; a palm left out counts as wrong.",
        lambda e: 100 * e.palms.within_30_deg,
    ),
    MetricDefinition(
        "palm_flipped_percent", "palms flipped", "%", "Share of the given normals more than 90 degrees off.",
        lambda e: 100 * e.palms.flipped,
    ),
)  # fmt: skip

METRICS: Final[tuple[MetricDefinition, ...]] = (
    *(_of_class(*metric, joints) for metric in _PER_CLASS for joints in CLASSES),
    *_PEOPLE,
    *_BODY,
    *_PALMS,
)
"""All metrics, in the order of the columns of table.csv."""

DEFINITION: Final = {m.key: m for m in METRICS}
"""key -> definition"""


def metric_values(evaluation: Evaluation) -> dict[str, float]:
    """Every metric by its key, in the unit of its definition; NaN where there is nothing to measure."""
    return {m.key: m.value(evaluation) for m in METRICS}
