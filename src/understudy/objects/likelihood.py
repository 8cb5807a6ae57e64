"""How well an articulation explains poses: Student's t, q integrated out, BIC and standard errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaln
from scipy.stats import chi2, norm

from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE, Articulation
from understudy.objects.motion import Hypotheses, Measured, derivatives, residuals, slope, tangents, whiten

_LEAST_M: Final = 0.01  # of the part's origin: what moves less was not operated
_LEAST_RAD: Final = float(np.radians(4))  # or this, where rotations were measured
_LARGEST_RADIUS_M: Final = 2.0  # of a hinge: twice the widest door leaf; beyond, it is a drawer, not quite straight
_CLEAR: Final = 7.0  # least range in standard deviations of q: noise alone spreads over 5 to 6 in some hundred poses
_INLIER: Final = 0.999  # quantile of an inlier's squared residual

UNKNOWNS: Final = {FIXED: (6, 3), PRISMATIC: (9, 6), REVOLUTE: (11, 8)}
"""By kind, the range's ends among them; where rotations were measured, and where none was."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """An articulation fitted to poses."""

    articulation: Articulation
    q: Float[np.ndarray, " n"]
    scale: Float[np.ndarray, "2"]
    """of the standard deviations of positions and rotations"""

    @property
    def hypothesis(self) -> Hypotheses:
        """The articulation as the functions of `motion` take it."""
        return Hypotheses.of(self.articulation)


@dataclass(frozen=True, eq=False)
class ArticulationErrors:
    """One standard deviation of what was fitted; 0 for what the kind does not have."""

    direction_rad: float
    """of the direction's angle, root of the sum over the two ways it can tilt"""
    point_m: float
    """of the axis's point, across the axis, likewise"""
    radius_m: float
    range: tuple[float, float]
    """of the ends of the range: radians or metres"""


def squares(r: Float[np.ndarray, "*b n k"]) -> Float[np.ndarray, "*b n"]:
    """Squared lengths of residuals."""
    return np.asarray((r**2).sum(axis=-1))


def weights(
    r2: Float[np.ndarray, "*b n"], dimensions: Float[np.ndarray, " n"], freedom: float
) -> Float[np.ndarray, "*b n"]:
    """Of poses in a reweighted least squares; freedom: degrees of Student's t, infinite for Gaussian noise."""
    return (freedom + dimensions) / (freedom + r2) if np.isfinite(freedom) else np.ones_like(r2)


def cost(r2: Float[np.ndarray, "*b n"], dimensions: Float[np.ndarray, " n"], freedom: float) -> Float[np.ndarray, "*b"]:
    """Minus the log density of Student's t, without its constants."""
    if not np.isfinite(freedom):
        return np.asarray(r2.sum(axis=-1) / 2)
    return np.asarray(((freedom + dimensions) / 2 * np.log1p(r2 / freedom)).sum(axis=-1))


def projected(
    h: Hypotheses, q: Float[np.ndarray, "*b n"], e: Float[np.ndarray, "*b n 6"], m: Measured
) -> Float[np.ndarray, "*b n 6 k"]:
    """Derivatives of whitened residuals by the articulation, each q following."""
    J = m.whitener @ derivatives(h, q, e)
    if h.kind == FIXED:
        return np.asarray(J)
    j = whiten(m, slope(h, q))
    j /= np.maximum(np.sqrt(squares(j)), 1e-12)[..., None]
    return np.asarray(J - j[..., None] * (j[..., None, :] @ J))


def inliers(fit: Fitted, m: Measured) -> Bool[np.ndarray, " n"]:
    """Which poses the articulation explains."""
    scaled = m.scaled(fit.scale)
    r2 = squares(whiten(scaled, residuals(fit.hypothesis, fit.q, scaled)))
    return np.asarray(r2 < chi2.ppf(_INLIER, m.dimensions))


def position_sigma(fit: Fitted, m: Measured) -> Float[np.ndarray, " n"]:
    """Standard deviation of each q, of a part that can move."""
    j = whiten(m.scaled(fit.scale), slope(fit.hypothesis, fit.q))
    return np.asarray(1 / np.maximum(np.sqrt(squares(j)), 1e-12))


def log_likelihood(fit: Fitted, m: Measured, freedom: float) -> float:
    """Of the poses, each q integrated over a flat prior on the range that was seen (Laplace's approximation)."""
    scaled, d = m.scaled(fit.scale), m.dimensions
    r2 = squares(whiten(scaled, residuals(fit.hypothesis, fit.q, scaled)))
    diagonal = np.diagonal(scaled.whitener, axis1=1, axis2=2)
    total = float(np.log(diagonal[:, :3]).sum() + np.log(diagonal[m.oriented, 3:]).sum() - cost(r2, d, freedom))
    if np.isfinite(freedom):
        constant = gammaln((freedom + d) / 2) - gammaln(freedom / 2) - d / 2 * np.log(freedom * np.pi)
    else:
        constant = -d / 2 * np.log(2 * np.pi)
    total += float(constant.sum())
    if fit.articulation.kind != FIXED:
        sigma = position_sigma(fit, m)
        low, high = fit.articulation.range
        width = max(high - low, 1e-9)
        inside = norm.cdf((high - fit.q) / sigma) - norm.cdf((low - fit.q) / sigma)
        total += float(np.log(np.maximum(sigma * np.sqrt(2 * np.pi) / width * inside, 1e-6)).sum())
    return total


def criterion(fit: Fitted, m: Measured, likelihood: float) -> float:
    """BIC; infinite for motions too small and hinges too large to be furniture's."""
    a = fit.articulation
    oriented = bool(m.oriented.any())
    if a.kind != FIXED:
        way = a.range[1] - a.range[0]
        turned = a.kind == REVOLUTE and oriented and way >= _LEAST_RAD
        shifted = way * (a.radius_m if a.kind == REVOLUTE else 1.0) >= _LEAST_M
        clear = way >= _CLEAR * float(np.median(position_sigma(fit, m)))
        if not (clear and (turned or shifted)) or a.radius_m > _LARGEST_RADIUS_M:
            return np.inf
    k = UNKNOWNS[a.kind][0 if oriented else 1]
    return float(k * np.log(len(m)) - 2 * likelihood)


def standard_errors(fit: Fitted, m: Measured, freedom: float) -> ArticulationErrors:
    """Standard deviations from the curvature, with Huber's correction for reweighting (1981, section 7.6)."""
    a, h, scaled = fit.articulation, fit.hypothesis, m.scaled(fit.scale)
    if a.kind == FIXED:
        return ArticulationErrors(0.0, 0.0, 0.0, (0.0, 0.0))
    e = residuals(h, fit.q, scaled)
    r2, d = squares(whiten(scaled, e)), m.dimensions
    w = weights(r2, d, freedom)
    change = -2 * w / (freedom + r2) if np.isfinite(freedom) else np.zeros_like(w)
    free = float((d - 1).sum())
    curvature = float((w * d + change * r2).sum() / d.sum())
    variance = float((w**2 * r2).sum()) / free / curvature**2
    J = projected(h, fit.q, e, scaled)
    columns = J.reshape(-1, J.shape[2])
    C = variance * np.linalg.pinv(columns.T @ columns, rcond=1e-9, hermitian=True)
    tilt, point, radius = float(np.sqrt(np.trace(C[6:8, 6:8]))), 0.0, 0.0
    if a.kind == REVOLUTE:
        B = tangents(a.direction)
        point = float(np.sqrt(np.trace(C[8:10, 8:10])))
        arm = B.T @ (a.T_rest[:3, 3] - a.point) / max(a.radius_m, 1e-12)
        by = np.concatenate([arm @ B.T, np.zeros(5), -arm])
        radius = float(np.sqrt(max(by @ C @ by, 0.0)))
    sigma = position_sigma(fit, m)
    low, high = (float(sigma[np.argmin(np.abs(fit.q - end))]) for end in a.range)
    return ArticulationErrors(tilt, point, radius, (low, high))
