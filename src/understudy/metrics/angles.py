"""Directions: limb bones, flexion of elbows and knees, palms. Pure functions; radians; NaN where there is no number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.geometry import angle_between
from understudy.metrics.joints import mean, median, share
from understudy.skeleton import JOINT

_CHAINS: Final = np.array(
    [
        [JOINT[f"{side}_{n}"] for n in chain]
        for chain in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
        for side in ("right", "left")
    ]
)
LIMB_BONES: Final = np.concatenate([_CHAINS[:, :2], _CHAINS[:, 1:]])
"""(8, 2) rows: upper arms and thighs, then forearms and shanks"""
HINGES: Final = _CHAINS
"""(4, 3) rows: shoulder-elbow-wrist and hip-knee-ankle"""
_MIN_LENGTH_M: Final = 1e-6
"""metres: a shorter bone has no direction"""

PALM_NEAR_RAD: Final = np.pi / 6
"""30 degrees"""
_ROUNDING_RAD: Final = 1e-9


def angles_or_nan(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Angles (radians) between vectors; NaN where one is NaN or has no length."""
    directed = (np.linalg.norm(a, axis=-1) > _MIN_LENGTH_M) & (np.linalg.norm(b, axis=-1) > _MIN_LENGTH_M)
    return np.where(directed, angle_between(a, b), np.nan)


def bone_direction_errors(
    predicted: Float[np.ndarray, "n 18 3"], truth: Float[np.ndarray, "n 18 3"]
) -> Float[np.ndarray, "n 8"]:
    """Angle between a limb bone and its truth (radians): LIMB_BONES. NaN unless both have both ends."""
    a, b = LIMB_BONES.T
    return angles_or_nan(predicted[:, b] - predicted[:, a], truth[:, b] - truth[:, a])


def flexion(keypoints: Float[np.ndarray, "n 18 3"]) -> Float[np.ndarray, "n 4"]:
    """Angle between the two bones at elbows and knees (radians; pi = straight): HINGES."""
    a, middle, b = HINGES.T
    return angles_or_nan(keypoints[:, a] - keypoints[:, middle], keypoints[:, b] - keypoints[:, middle])


def flexion_errors(
    predicted: Float[np.ndarray, "n 18 3"], truth: Float[np.ndarray, "n 18 3"]
) -> Float[np.ndarray, "n 4"]:
    """Absolute difference of `flexion` (radians); NaN unless both have the three joints."""
    return np.asarray(np.abs(flexion(predicted) - flexion(truth)))


def mean_given(angles: Float[np.ndarray, "*n"]) -> float:
    """Mean of those that are numbers."""
    return mean(angles[~np.isnan(angles)])


@dataclass(frozen=True, eq=False)
class PalmMetrics:
    """Palm normals of hands that are in view and have truth, pooled."""

    n_truth: int
    """hands in view with a true normal, also those of missed people"""
    n_given: int
    """of these, hands for which the method gave a normal"""
    coverage: float
    """n_given / n_truth"""
    mean_rad: float
    """mean angle between normal and truth, of the given"""
    median_rad: float
    """median of the same"""
    within_30_deg: float
    """share of the n_truth normals within 30 degrees; one that is not given is wrong"""
    flipped: float
    """share of the given normals more than 90 degrees off: palm taken for back of the hand"""

    @classmethod
    def of(
        cls,
        predicted: Float[np.ndarray, "n 2 3"],
        truth: Float[np.ndarray, "n 2 3"],
        in_view: Bool[np.ndarray, "n 2"],
    ) -> PalmMetrics:
        """From normals (left, right), NaN where there is none."""
        errors = angles_or_nan(predicted, truth)[in_view & ~np.isnan(truth).any(axis=-1)]
        given = errors[~np.isnan(errors)]
        return cls(
            n_truth=errors.size,
            n_given=given.size,
            coverage=share(~np.isnan(errors)),
            mean_rad=mean(given),
            median_rad=median(given),
            within_30_deg=share(errors <= PALM_NEAR_RAD + _ROUNDING_RAD),
            flipped=share(given > np.pi / 2 + _ROUNDING_RAD),
        )
