"""All metrics of one method: `evaluate(predicted, truth)`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool

from understudy.metrics.angles import PalmMetrics, bone_direction_errors, flexion_errors, mean_given
from understudy.metrics.calibration import Calibration
from understudy.metrics.joints import JointMetrics, position_errors, share, swapped_sides
from understudy.metrics.matching import DEFAULT_RULE, MatchRule
from understudy.metrics.observations import Counts, Observations, observe
from understudy.people_file import FramePeople
from understudy.recordings.truth import Truth
from understudy.skeleton import JOINTS

CLASSES: Final = ("all", "visible", "occluded", "out_of_view", "in_view")
"""Classes of joints: visible (in view, not occluded), occluded (in view, hidden), out of view; in view."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One method on one recording or on several. Every number is pooled: an average over joints, not of averages."""

    joints: dict[str, JointMetrics]
    """class of joints (CLASSES) -> metrics"""
    per_joint: dict[str, JointMetrics]
    """joint name -> metrics, visible or not"""
    counts: Counts
    swapped: float
    """share of left-right pairs that are swapped (`swapped_sides`)"""
    n_side_pairs: int
    """pairs for which it could be told"""
    bone_direction_rad: float
    """mean error of the directions of the limb bones whose ends are both given"""
    flexion_rad: float
    """mean error of the angles of elbows and knees whose three joints are given"""
    calibration: Calibration
    palms: PalmMetrics


def evaluate(predicted: Iterable[FramePeople], truth: Truth, rule: MatchRule = DEFAULT_RULE) -> Evaluation:
    """All metrics of one recording. Frames with truth that the prediction lacks or skipped count as all missed."""
    return summarise(observe(predicted, truth, rule))


def joint_classes(observations: Observations) -> dict[str, Bool[np.ndarray, "n 18"]]:
    """Class name -> which joints belong to it. A joint without truth belongs to none."""
    o = observations
    known = ~np.isnan(o.truth[..., 0])
    return {
        "all": known,
        "visible": known & o.in_view & ~o.occluded,
        "occluded": known & o.in_view & o.occluded,
        "out_of_view": known & ~o.in_view,
        "in_view": known & o.in_view,
    }


def summarise(observations: Observations) -> Evaluation:
    """All metrics of observations, which may be pooled from several recordings (`Observations.pooled`)."""
    o = observations
    errors = position_errors(o.predicted, o.truth)
    classes = joint_classes(o)
    swapped, told = swapped_sides(o.predicted, o.truth)
    return Evaluation(
        joints={name: JointMetrics.of(errors[classes[name]]) for name in CLASSES},
        per_joint={name: JointMetrics.of(errors[:, i][classes["all"][:, i]]) for i, name in enumerate(JOINTS)},
        counts=o.counts,
        swapped=share(swapped[told]),
        n_side_pairs=int(told.sum()),
        bone_direction_rad=mean_given(bone_direction_errors(o.predicted, o.truth)),
        flexion_rad=mean_given(flexion_errors(o.predicted, o.truth)),
        calibration=Calibration.of(errors.ravel(), o.confidence.ravel(), o.sigma_m.ravel()),
        palms=PalmMetrics.of(o.palms_predicted, o.palms_truth, o.palms_in_view),
    )
