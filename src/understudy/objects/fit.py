"""Which articulation a track of poses shows, by maximum likelihood and the Bayesian information criterion.

After Sturm, Stachniss & Burgard 2011 ("A probabilistic framework for learning kinematic models of articulated
objects", section 4): a model per kind, fitted robustly, the kind chosen by BIC. Where we differ: residuals are
Student-t instead of a mixture with outliers, noise is scaled by what is left over, and q is integrated out with a
flat prior over its range instead of being maximised over: that is what makes 'fixed' win when nothing moved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaln
from scipy.stats import chi2, norm

from understudy.errors import UnderstudyError, one_of
from understudy.objects.articulation import FIXED, KINDS, PRISMATIC, REVOLUTE, Articulation
from understudy.objects.candidates import candidates
from understudy.objects.motion import (
    Measured,
    derivatives,
    measured,
    residuals,
    slope,
    solve_positions,
    stepped,
    tangents,
    whiten,
)

_SIGMA: Final = (0.001, np.radians(5.0))  # metres, radians: where no covariance is given. Rotations of markers err with
# the view (in Sturm's kitchen they turn 5 to 10 % less than their positions do), so they count little against positions
_LEAST_SCALE: Final = 0.02  # of the noise where no covariance is given; where it is, 1: it may promise too much only
_LARGEST_SCALE: Final = 1e3
_FREEDOM: Final = 5.0  # degrees of freedom of Student's t
_LEAST_M: Final = 0.01  # of the part's origin: what moves less was not operated
_LEAST_RAD: Final = float(np.radians(4))  # or this, where rotations were measured
_LARGEST_RADIUS_M: Final = (
    2.0  # of a hinge: twice the widest door leaf; beyond, it is a drawer that is not quite straight
)
_UNKNOWNS: Final = {FIXED: (6, 3), PRISMATIC: (9, 6), REVOLUTE: (11, 8)}  # with the range; with and without rotations
_ROUNDS: Final = 10  # of the noise's scale
_RESCALED: Final = 4  # times in each
_SETTLED: Final = 0.01  # relative change of it
_ITERATIONS: Final = 6  # of Levenberg-Marquardt, in each round
_NOTHING: Final = 1e-4  # gain of log likelihood that is not worth a further step
_REFINED: Final = 2  # of the candidates
_SAMPLE: Final = 50  # poses, evenly over the track, that candidates are judged by
_CLEAR: Final = 7.0  # least range in standard deviations of q: noise alone spreads over 5 to 6 in some hundred poses
_LEAST_POSES: Final = 5
_INLIER: Final = 0.999  # quantile of an inlier's squared residual


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


@dataclass(frozen=True, eq=False)
class _Fitted:
    articulation: Articulation
    q: np.ndarray
    scale: np.ndarray
    cost: float
    log_likelihood: float = -np.inf


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
    fits = {kind: _fit_kind(kind, m, covariance is None, freedom, random) for kind in kinds}
    bic = {kind: _criterion(fit, m) for kind, fit in fits.items()}
    best = fits[min(bic, key=lambda kind: bic[kind])]
    scaled = m.scaled(best.scale)
    e = residuals(best.articulation, best.q, scaled)
    inlier = _squares(whiten(scaled, e)) < chi2.ppf(_INLIER, m.dimensions)
    q, everywhere = np.full(len(known), np.nan), np.zeros(len(known), bool)
    q[known], everywhere[known] = best.q, inlier
    turned = inlier & m.oriented
    return ArticulationFit(
        best.articulation,
        q,
        {kind: fit.log_likelihood for kind, fit in fits.items()},
        bic,
        {kind: fit.articulation for kind, fit in fits.items()},
        float(np.sqrt(_squares(e[inlier, :3]).mean())) if inlier.any() else float("nan"),
        float(np.sqrt(_squares(e[turned, 3:]).mean())) if turned.any() else float("nan"),
        (float(best.scale[0]), float(best.scale[1])),
        _errors(best, scaled, freedom),
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


def _squares(r: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
    return np.asarray((r**2).sum(axis=1))


def _weights(r2: np.ndarray, dimensions: np.ndarray, freedom: float) -> np.ndarray:
    return (freedom + dimensions) / (freedom + r2) if np.isfinite(freedom) else np.ones_like(r2)


def _cost(r2: np.ndarray, dimensions: np.ndarray, freedom: float) -> float:
    """Minus the log density of Student's t, without its constants."""
    if not np.isfinite(freedom):
        return float(r2.sum() / 2)
    return float(((freedom + dimensions) / 2 * np.log1p(r2 / freedom)).sum())


def _fit_kind(kind: str, m: Measured, free: bool, freedom: float, random: np.random.Generator) -> _Fitted:
    """The likeliest articulation of one kind: random starts, then reweighted least squares."""
    starts = candidates(kind, m, random)
    sample = m.part(np.unique(np.linspace(0, len(m) - 1, min(len(m), _SAMPLE)).astype(int)))
    d = sample.dimensions
    costs = []
    for start in starts:
        e = residuals(start, solve_positions(start, sample, steps=1), sample)
        costs.append(_cost(_squares(whiten(sample, e)), d, _FREEDOM))
    few = [_refined(starts[i], sample, free, freedom, 2) for i in np.argsort(costs, kind="stable")[:_REFINED]]
    best = _rested(_refined(min(few, key=lambda fit: fit.cost).articulation, m, free, freedom, _ROUNDS), m)
    return replace(best, log_likelihood=_log_likelihood(best, m, freedom))


def _refined(start: Articulation, m: Measured, free: bool, freedom: float, rounds: int) -> _Fitted:
    """Alternates between the articulation (Levenberg-Marquardt) and the scale of the noise."""
    scale = np.ones(2)
    articulation, d, cost = start, m.dimensions, np.inf
    for _ in range(rounds):
        scaled = m.scaled(scale)
        articulation, q, e = _minimised(articulation, scaled, freedom)
        previous = scale
        for _ in range(_RESCALED):
            scaled = m.scaled(scale)
            r = whiten(scaled, e)
            scale = _bounded(scale * _spread(articulation, q, r, scaled, freedom), free)
        if np.abs(np.log(scale / previous)).max() < _SETTLED:
            break
    scaled = m.scaled(scale)
    r2 = _squares(whiten(scaled, residuals(articulation, q, scaled)))
    cost = _cost(r2, d, freedom) + len(m) * 3 * np.log(scale[0]) + m.oriented.sum() * 3 * np.log(scale[1])
    return _Fitted(articulation, q, scale, float(cost))


def _bounded(scale: Float[np.ndarray, "2"], free: bool) -> Float[np.ndarray, "2"]:
    """Scales of noise that are believed; of an unknown noise, that of rotations does not fall below positions'."""
    scale = np.clip(scale, _LEAST_SCALE if free else 1.0, _LARGEST_SCALE)
    return np.array([scale[0], scale.max()]) if free else scale


def _minimised(
    articulation: Articulation, m: Measured, freedom: float
) -> tuple[Articulation, Float[np.ndarray, " n"], Float[np.ndarray, "n 6"]]:
    """Levenberg-Marquardt on the articulation's unknowns at a given noise: the articulation, q and residuals."""
    d, damping = m.dimensions, 1e-4
    q = solve_positions(articulation, m)
    e = residuals(articulation, q, m)
    r = whiten(m, e)
    cost = _cost(_squares(r), d, freedom)
    for _ in range(_ITERATIONS):
        w = _weights(_squares(r), d, freedom)
        J = _projected(articulation, q, e, m)
        columns = J.reshape(-1, J.shape[2])
        weighted = (w[:, None, None] * J).reshape(columns.shape)
        H, g = weighted.T @ columns, weighted.T @ r.ravel()
        # what does not change the motion (a rest pose elsewhere along it) has no curvature: damp it
        size = np.diag(H) + 1e-9 * np.trace(H)
        trial = stepped(articulation, -np.linalg.solve(H + np.diag(damping * size), g))
        trial_q = solve_positions(trial, m, q, steps=2)
        trial_e = residuals(trial, trial_q, m)
        trial_r = whiten(m, trial_e)
        trial_cost = _cost(_squares(trial_r), d, freedom)
        if trial_cost < cost:
            gain = cost - trial_cost
            articulation, q, e, r, cost = trial, trial_q, trial_e, trial_r, trial_cost
            damping = max(damping / 10, 1e-9)
            if gain < _NOTHING:
                break
        else:
            damping *= 30
    return articulation, q, e


def _projected(articulation: Articulation, q: np.ndarray, e: np.ndarray, m: Measured) -> Float[np.ndarray, "n 6 k"]:
    """Derivatives of whitened residuals by the articulation, each q following."""
    J = whiten(m, derivatives(articulation, q, e))
    if articulation.kind == FIXED:
        return J
    j = whiten(m, slope(articulation, q))
    j /= np.maximum(np.linalg.norm(j, axis=1, keepdims=True), 1e-12)
    return J - j[:, :, None] * (j[:, None] @ J)


def _spread(articulation: Articulation, q: np.ndarray, r: np.ndarray, m: Measured, freedom: float) -> np.ndarray:
    """Ratio of the residuals to what the noise explains, for positions and for rotations; 1 = as expected."""
    w = _weights(_squares(r), m.dimensions, freedom)
    j = whiten(m, slope(articulation, q))
    share = j**2 / np.maximum(_squares(j), 1e-12)[:, None]  # each q takes one dimension, shared as it can see them
    used = 1 - _UNKNOWNS[articulation.kind][0] / max(float(m.dimensions.sum()), 12.0)
    out = np.ones(2)
    for k, rows in enumerate((slice(0, 3), slice(3, 6))):
        there = np.ones(len(m), bool) if k == 0 else m.oriented
        expected = (3 - share[there, rows].sum(axis=1)).sum() * used
        if expected > 0:
            out[k] = np.sqrt(max(float((w[there] * _squares(r[there, rows])).sum() / expected), 1e-6))
    return out


def _rested(fit: _Fitted, m: Measured) -> _Fitted:
    """q = 0 where the track starts, and positive where it goes; the range of the inliers."""
    a, q = fit.articulation, fit.q
    if a.kind == FIXED:
        return replace(fit, articulation=replace(a, point=a.T_rest[:3, 3].copy()))
    scaled = m.scaled(fit.scale)
    r2 = _squares(whiten(scaled, residuals(a, q, scaled)))
    inlier = r2 < chi2.ppf(_INLIER, m.dimensions)
    inlier = inlier if inlier.sum() >= _LEAST_POSES else np.ones(len(m), bool)
    if a.kind == REVOLUTE:  # the circle is cut opposite to where the motion is
        middle = float(np.angle(np.exp(1j * q[inlier]).mean()))
        q = middle + np.pi - (middle + np.pi - q) % (2 * np.pi)
    sigma = 1 / np.maximum(np.linalg.norm(whiten(scaled, slope(a, q)), axis=1), 1e-12)
    first = np.flatnonzero(inlier)
    q0 = float(np.median(q[first[:3]]))
    gone = np.abs(q[first] - q0) > 3 * sigma[first]
    rest = first[: max(int(np.argmax(gone)) if gone.any() else len(first), 1)]
    q0 = float(np.median(q[rest]))
    moved = q - q0
    sign = 1.0 if moved[inlier].max() + moved[inlier].min() >= 0 else -1.0
    T_rest = a.pose(np.array([q0]))[0]
    point = T_rest[:3, 3].copy()
    if a.kind == REVOLUTE:
        point = a.point + a.direction * (a.direction @ (point - a.point))
    low, high = float((sign * moved[inlier]).min()), float((sign * moved[inlier]).max())
    rested = Articulation(a.kind, T_rest, sign * a.direction, point, (low, high))
    return replace(fit, articulation=rested, q=sign * moved)


def _log_likelihood(fit: _Fitted, m: Measured, freedom: float) -> float:
    """Of the poses, each q integrated over a flat prior on the range that was seen (Laplace's approximation)."""
    a, scaled, d = fit.articulation, m.scaled(fit.scale), m.dimensions
    r2 = _squares(whiten(scaled, residuals(a, fit.q, scaled)))
    diagonal = np.diagonal(scaled.whitener, axis1=1, axis2=2)
    total = float(np.log(diagonal[:, :3]).sum() + np.log(diagonal[m.oriented, 3:]).sum()) - _cost(r2, d, freedom)
    if np.isfinite(freedom):
        constant = gammaln((freedom + d) / 2) - gammaln(freedom / 2) - d / 2 * np.log(freedom * np.pi)
    else:
        constant = -d / 2 * np.log(2 * np.pi)
    total += float(constant.sum())
    if a.kind != FIXED:
        sigma = 1 / np.maximum(np.linalg.norm(whiten(scaled, slope(a, fit.q)), axis=1), 1e-12)
        low, high = a.range
        width = max(high - low, 1e-9)
        inside = norm.cdf((high - fit.q) / sigma) - norm.cdf((low - fit.q) / sigma)
        total += float(np.log(np.maximum(sigma * np.sqrt(2 * np.pi) / width * inside, 1e-6)).sum())
    return total


def _criterion(fit: _Fitted, m: Measured) -> float:
    """BIC; infinite for motions too small and hinges too large to be furniture's."""
    a = fit.articulation
    oriented = bool(m.oriented.any())
    if a.kind != FIXED:
        way = a.range[1] - a.range[0]
        turned = a.kind == REVOLUTE and oriented and way >= _LEAST_RAD
        shifted = way * (a.radius_m if a.kind == REVOLUTE else 1.0) >= _LEAST_M
        sigma = 1 / np.linalg.norm(whiten(m.scaled(fit.scale), slope(a, fit.q)), axis=1).clip(1e-12)
        clear = way >= _CLEAR * float(np.median(sigma))
        if not (clear and (turned or shifted)) or a.radius_m > _LARGEST_RADIUS_M:
            return np.inf
    k = _UNKNOWNS[a.kind][0 if oriented else 1]
    return float(k * np.log(len(m)) - 2 * fit.log_likelihood)


def _errors(fit: _Fitted, m: Measured, freedom: float) -> ArticulationErrors:
    """Standard deviations from the curvature, with Huber's correction for reweighting (1981, section 7.6)."""
    a = fit.articulation
    if a.kind == FIXED:
        return ArticulationErrors(0.0, 0.0, 0.0, (0.0, 0.0))
    e = residuals(a, fit.q, m)
    r2, d = _squares(whiten(m, e)), m.dimensions
    w = _weights(r2, d, freedom)
    change = -2 * w / (freedom + r2) if np.isfinite(freedom) else np.zeros_like(w)
    free = float((d - 1).sum())
    curvature = float((w * d + change * r2).sum() / d.sum())
    variance = float((w**2 * r2).sum()) / free / curvature**2
    J = _projected(a, fit.q, e, m)
    columns = J.reshape(-1, J.shape[2])
    C = variance * np.linalg.pinv(columns.T @ columns, rcond=1e-9, hermitian=True)
    tilt, point, radius = float(np.sqrt(np.trace(C[6:8, 6:8]))), 0.0, 0.0
    if a.kind == REVOLUTE:
        B = tangents(a.direction)
        point = float(np.sqrt(np.trace(C[8:10, 8:10])))
        arm = B.T @ (a.T_rest[:3, 3] - a.point) / max(a.radius_m, 1e-12)
        by = np.concatenate([arm @ B.T, np.zeros(5), -arm])
        radius = float(np.sqrt(max(by @ C @ by, 0.0)))
    sigma = 1 / np.maximum(np.linalg.norm(whiten(m, slope(a, fit.q)), axis=1), 1e-12)
    low, high = (float(sigma[np.argmin(np.abs(fit.q - end))]) for end in a.range)
    return ArticulationErrors(tilt, point, radius, (low, high))
