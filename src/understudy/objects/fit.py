"""Which articulation a track of poses shows, by maximum likelihood and the Bayesian information criterion.

After Sturm, Stachniss & Burgard 2011 ("A probabilistic framework for learning kinematic models of articulated
objects", section 4): a model per kind, fitted robustly, the kind chosen by BIC. Where we differ: residuals are
Student-t instead of a mixture with outliers, noise is scaled by what is left over, and q is integrated out with a
flat prior over its range instead of being maximised over: that is what makes 'fixed' win when nothing moved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.errors import UnderstudyError, one_of
from understudy.objects.articulation import KINDS, Articulation
from understudy.objects.likelihood import (
    ArticulationErrors,
    criterion,
    inliers,
    log_likelihood,
    squares,
    standard_errors,
)
from understudy.objects.motion import Measured, measured, residuals
from understudy.objects.refinement import fit_kind

_SIGMA: Final = (0.001, np.radians(5.0))  # metres, radians: where no covariance is given. Rotations of markers err with
# the view (in Sturm's kitchen they turn 5 to 10 % less than their positions do), so they count little against positions
_FREEDOM: Final = 5.0  # degrees of freedom of Student's t
_LEAST_POSES: Final = 5


@dataclass(frozen=True, eq=False)
class ArticulationFit:
    """The likeliest articulation of a track, and how sure that is."""

    articulation: Articulation
    q: Float[np.ndarray, " n"]
    """of every pose: radians or metres; NaN where there was none"""
    log_likelihood: Mapping[str, float]
    """by kind; natural logarithm"""
    bic: Mapping[str, float]
    """by kind, the least was chosen; infinite where a model stands outside of what furniture does"""
    fits: Mapping[str, Articulation]
    """the best articulation of each kind"""
    rms_m: float
    """of the inliers' positions"""
    rms_rad: float
    """of their rotations; NaN where none was measured"""
    noise_scale: tuple[float, float]
    """what standard deviations of positions and rotations had to be multiplied by to explain the residuals"""
    errors: ArticulationErrors
    inlier: Bool[np.ndarray, " n"]
    """false for outliers and where there was no pose"""


def fit_articulation(
    T_world_part: Float[np.ndarray, "n 4 4"],
    covariance: Float[np.ndarray, "n 6 6"] | None = None,
    *,
    kinds: Sequence[str] = KINDS,
    robust: bool = True,
    seed: int = 0,
) -> ArticulationFit:
    """Fits articulations to a track of poses in order of time, and chooses among them.

    T_world_part: NaN where there is no pose; the rotation alone NaN where only the position was measured.
    covariance: of (dp, dr), metres and radians, along the world's axes, as in PoseTrack; infinite variances of rotation
    leave the rotation out. Without it, the noise is estimated.
    robust: against outliers. seed: of the random starts.

    The result rests at q = 0 where the track starts, and opening is positive. Raises UnderstudyError for fewer than 5
    poses, unknown kinds, or a covariance that is none.
    """
    m, known = _checked(T_world_part, covariance, kinds)
    freedom = _FREEDOM if robust else np.inf
    random = np.random.default_rng(seed)
    fits = {kind: fit_kind(kind, m, covariance is None, freedom, random) for kind in kinds}
    likelihood = {kind: log_likelihood(fit, m, freedom) for kind, fit in fits.items()}
    bic = {kind: criterion(fit, m, likelihood[kind]) for kind, fit in fits.items()}
    best = fits[min(bic, key=lambda kind: bic[kind])]
    e, inlier = residuals(best.hypothesis, best.q, m), inliers(best, m)
    q, everywhere = np.full(len(known), np.nan), np.zeros(len(known), bool)
    q[known], everywhere[known] = best.q, inlier
    turned = inlier & m.oriented
    return ArticulationFit(
        best.articulation,
        q,
        likelihood,
        bic,
        {kind: fit.articulation for kind, fit in fits.items()},
        float(np.sqrt(squares(e[inlier, :3]).mean())) if inlier.any() else float("nan"),
        float(np.sqrt(squares(e[turned, 3:]).mean())) if turned.any() else float("nan"),
        (float(best.scale[0]), float(best.scale[1])),
        standard_errors(best, m, freedom),
        everywhere,
    )


def _checked(T: np.ndarray, covariance: np.ndarray | None, kinds: Sequence[str]) -> tuple[Measured, np.ndarray]:
    n = len(T)
    if T.shape != (n, 4, 4) or (covariance is not None and covariance.shape != (n, 6, 6)):
        raise UnderstudyError("an articulation is fitted to poses (n, 4, 4) and covariances (n, 6, 6)")
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not kinds:
        raise UnderstudyError(f"articulation: kinds {list(kinds)} must be {one_of(KINDS)}")
    known = np.isfinite(T[:, :3, 3]).all(axis=1)
    if known.sum() < _LEAST_POSES:
        raise UnderstudyError(f"an articulation needs {_LEAST_POSES} poses or more, got {int(known.sum())}")
    if covariance is None:
        covariance = np.tile(np.diag(np.repeat(_SIGMA, 3) ** 2), (n, 1, 1))
    if not np.isfinite(covariance[known, :3, :3]).all():
        raise UnderstudyError("covariance of poses: those of the positions must be finite")
    return measured(T[known], covariance[known]), known
