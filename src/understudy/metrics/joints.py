"""Joint positions: EPE, coverage, PCK, area under PCK, swapped sides. Pure functions; metres; NaN for no number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.skeleton import rows

PCK_LIMIT_M: Final = 0.20
"""metres: right end of the PCK curve"""
PCK_THRESHOLDS_M: Final = np.linspace(0.0, PCK_LIMIT_M, 201)
"""metres: where the curve is sampled, every millimetre"""
PCK_AT_M: Final = 0.10
"""metres: the threshold of the PCK that tables show"""
_ROUNDING_M: Final = 1e-9
"""metres: a joint at the threshold is within it, whatever the rounding"""

SWAP_MIN_APART_M: Final = 0.10
"""metres: sides nearer to each other than this in truth cannot be told swapped"""
SIDE_PAIRS: Final = np.column_stack(
    [
        rows(*(f"{side}_{n}" for n in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")))
        for side in ("right", "left")
    ]
)
"""(6, 2) rows: right, left"""


def share(of: Bool[np.ndarray, "*n"]) -> float:
    """Share of True; NaN of nothing."""
    return float(of.mean()) if of.size else float("nan")


def mean(of: Float[np.ndarray, "*n"]) -> float:
    """Mean; NaN of nothing."""
    return float(of.mean()) if of.size else float("nan")


def median(of: Float[np.ndarray, "*n"]) -> float:
    """Median; NaN of nothing."""
    return float(np.median(of)) if of.size else float("nan")


def position_errors(predicted: Float[np.ndarray, "*n 3"], truth: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Euclidean errors (metres); NaN where either has no position."""
    return np.asarray(np.linalg.norm(predicted - truth, axis=-1))


def pck(errors_m: Float[np.ndarray, " n"], thresholds_m: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Share of all n joints with an error of at most each threshold. NaN: a joint not given, hence wrong."""
    if not errors_m.size:
        return np.full(len(thresholds_m), np.nan)
    given = np.sort(errors_m[~np.isnan(errors_m)])
    return np.asarray(np.searchsorted(given, thresholds_m + _ROUNDING_M, side="right") / errors_m.size)


def area_under_pck(errors_m: Float[np.ndarray, " n"]) -> float:
    """Area under the PCK curve from 0 to 20 cm, over its width: in [0, 1]; exact, not from samples of the curve.

    A joint with error e adds a step at e, so its share of the area is 1 - e / 20 cm, and 0 beyond or when not given.
    """
    return mean(np.clip(1.0 - np.nan_to_num(errors_m, nan=np.inf) / PCK_LIMIT_M, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class JointMetrics:
    """One class of joints (or one joint), pooled."""

    n_truth: int
    """joints with truth of all counted people, the missed ones too"""
    n_given: int
    """of these, joints for which the method gave a position"""
    epe_m: float
    """mean Euclidean error of the given joints"""
    epe_median_m: float
    """median Euclidean error of the given joints"""
    coverage: float
    """n_given / n_truth"""
    pck_curve: Float[np.ndarray, "201"]
    """share of the n_truth joints within each of PCK_THRESHOLDS_M; joints not given are wrong"""
    pck: float
    """the curve at 10 cm"""
    pck_given: float
    """share of the n_given joints within 10 cm: leaves out what the method left out"""
    auc: float
    """area under the curve, in [0, 1]"""

    @classmethod
    def of(cls, errors_m: Float[np.ndarray, " n"]) -> JointMetrics:
        """From the errors of all joints with truth, NaN where no position was given."""
        given = errors_m[~np.isnan(errors_m)]
        at = np.array([PCK_AT_M])
        return cls(
            n_truth=errors_m.size,
            n_given=given.size,
            epe_m=mean(given),
            epe_median_m=median(given),
            coverage=share(~np.isnan(errors_m)),
            pck_curve=pck(errors_m, PCK_THRESHOLDS_M),
            pck=float(pck(errors_m, at)[0]),
            pck_given=float(pck(given, at)[0]),
            auc=area_under_pck(errors_m),
        )


def swapped_sides(
    predicted: Float[np.ndarray, "n 18 3"], truth: Float[np.ndarray, "n 18 3"]
) -> tuple[Bool[np.ndarray, "n 6"], Bool[np.ndarray, "n 6"]]:
    """Per person and pair of sides (shoulder, elbow, wrist, hip, knee, ankle): swapped?, and can it be told?

    Swapped: both joints are nearer to the other side's truth than to their own. It can be told where both sides are
    given and their truths are at least 10 cm apart.
    """
    p, t = predicted[:, SIDE_PAIRS], truth[:, SIDE_PAIRS]
    own = position_errors(p, t)
    other = position_errors(p, t[..., ::-1, :])
    apart = position_errors(t[..., 0, :], t[..., 1, :])
    told = ~np.isnan(own).any(axis=-1) & (apart >= SWAP_MIN_APART_M)
    return told & (other < own).all(axis=-1), told
