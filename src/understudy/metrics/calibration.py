"""Does the method know how good it is? Confidence and sigma against the errors that came out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.metrics.joints import share

CONFIDENT_WITHIN_M: Final = 0.10
"""metres: `confidence` is the probability of an error of at most this"""
N_BINS: Final = 10
EXPECTED_WITHIN_SIGMA: Final = (0.68, 0.9971)
"""shares of errors within 1 and 2 sigma: what sigma means, and what an isotropic 3D Gaussian then has within 2"""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Over the given joints of matched people, pooled. Joints that are not given say nothing and are left out."""

    n: int
    """joints with a confidence"""
    ece: float
    """expected calibration error: mean over bins, weighted by joints, of |mean confidence - share within 10 cm|"""
    bin_confidence: Float[np.ndarray, "10"]
    """mean confidence of the joints in each of 10 equally wide bins; NaN in an empty one"""
    bin_share: Float[np.ndarray, "10"]
    """share of them within 10 cm"""
    bin_count: Float[np.ndarray, "10"]
    """joints in the bin"""
    n_sigma: int
    """joints with a sigma"""
    within_1_sigma: float
    """share of errors of at most sigma; 0.68 when sigma is right"""
    within_2_sigma: float
    """share of errors of at most 2 sigma; 0.997 for Gaussian errors, less where errors have tails"""

    @classmethod
    def of(
        cls, errors_m: Float[np.ndarray, " n"], confidence: Float[np.ndarray, " n"], sigma_m: Float[np.ndarray, " n"]
    ) -> Calibration:
        """From errors (metres; NaN where not given or without truth), confidences and sigmas (metres)."""
        count, mean_confidence, share_within = _bins(errors_m, confidence)
        gaps = np.nan_to_num(np.abs(mean_confidence - share_within))
        known = ~(np.isnan(errors_m) | np.isnan(sigma_m))
        error, sigma = errors_m[known], sigma_m[known]
        return cls(
            n=int(count.sum()),
            ece=float(gaps @ count / count.sum()) if count.sum() else float("nan"),
            bin_confidence=mean_confidence,
            bin_share=share_within,
            bin_count=count,
            n_sigma=error.size,
            within_1_sigma=share(error <= sigma),
            within_2_sigma=share(error <= 2 * sigma),
        )


def _bins(errors_m: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per bin: count, mean confidence, share within 10 cm."""
    known = ~(np.isnan(errors_m) | np.isnan(confidence))
    sure = np.clip(confidence[known], 0.0, 1.0)
    right = (errors_m[known] <= CONFIDENT_WITHIN_M + 1e-9).astype(float)
    bin_of = np.minimum((sure * N_BINS).astype(int), N_BINS - 1)
    count, total, hits = (
        np.bincount(bin_of, weights, N_BINS).astype(float) for weights in (np.ones_like(sure), sure, right)
    )
    some = np.where(count > 0, count, np.nan)
    return count, total / some, hits / some
