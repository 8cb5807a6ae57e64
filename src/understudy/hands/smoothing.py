"""Rotations over time, smoothed without lag: a local fit of a steady turn to the measurements before and after.

For recordings (it looks ahead). Measurements may be missing, doubtful, or turned round altogether now and then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from understudy.errors import UnderstudyError

_WINDOW: Final = 3.0  # sigmas to either side
_DOUBT: Final = np.radians(20)  # residuals of this size lose half of their weight
_PASSES: Final = 4  # of reweighting
_BLOCK: Final = 256  # moments at a time
_STIFF: Final = 0.002  # of the slope, in units of the window: where one side has no measurements, it is kept small
_ENOUGH: Final = 0.3  # least sum of weights, in units of one sure measurement at the moment itself


@dataclass(frozen=True, eq=False)
class SmoothRotations:
    """Smoothed rotations of n moments."""

    R: Float[np.ndarray, "n 3 3"]
    """NaN where no measurement is near"""
    spread: Float[np.ndarray, " n"]
    """radians: RMS of the residuals of the measurements around each moment; NaN as `R`"""
    support: Float[np.ndarray, " n"]
    """how many sure measurements each rotation rests on"""


def smooth_rotations(
    times_s: Float[np.ndarray, " n"],
    R: Float[np.ndarray, "_ 3 3"],
    confidence: Float[np.ndarray, " _"] | None = None,
    sigma_s: float = 0.12,
) -> SmoothRotations:
    """Smooths measured rotations.

    times_s: increasing. R: NaN where there is no measurement. confidence: weights in [0, 1]; 1 when not given.
    sigma_s: of the Gaussian window, seconds. In the window a constant angular velocity is fitted (least squares in the
    tangent space of the weighted mean, reweighted by Cauchy's function against outliers), so that a steady turn
    is neither delayed nor shortened, not at the ends either.
    Raises UnderstudyError when times do not increase or shapes do not fit.
    """
    times_s, R = np.asarray(times_s, np.float64), np.asarray(R, np.float64)
    n = len(times_s)
    weight = np.ones(n) if confidence is None else np.asarray(confidence, np.float64)
    if R.shape != (n, 3, 3) or weight.shape != (n,):
        raise UnderstudyError(
            f"{n} times need R of shape ({n}, 3, 3) and confidence ({n},), got {R.shape}, {weight.shape}"
        )
    if not (np.diff(times_s) > 0).all() or not sigma_s > 0:
        raise UnderstudyError("times must increase, and sigma_s must be positive")
    if not ((weight >= 0) & (weight <= 1)).all():
        raise UnderstudyError("confidence must be in [0, 1]")
    known = np.flatnonzero(np.isfinite(R).all(axis=(1, 2)) & (weight > 0))
    out, spread, support = np.full((n, 3, 3), np.nan), np.full(n, np.nan), np.zeros(n)
    for start in range(0, n, _BLOCK):
        block = np.arange(start, min(start + _BLOCK, n))
        low, high = times_s[block[[0, -1]]] + np.array([-_WINDOW, _WINDOW]) * sigma_s
        near = known[(times_s[known] >= low) & (times_s[known] <= high)]
        if len(near):
            part = _fit(times_s[block], times_s[near], Rotation.from_matrix(R[near]), weight[near], sigma_s)
            out[block], spread[block], support[block] = part
    return SmoothRotations(out, spread, support)


def _fit(
    at: Float[np.ndarray, " b"],
    times: Float[np.ndarray, " m"],
    measured: Rotation,
    weight: Float[np.ndarray, " m"],
    sigma: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations, spreads and supports at b moments from m measurements."""
    b, m = len(at), len(times)
    lag = (times - at[:, None]) / sigma
    base = np.where(np.abs(lag) <= _WINDOW, np.exp(-0.5 * lag**2), 0.0) * weight
    w = base.copy()
    q = measured.as_quat()
    angle = np.zeros((b, m))
    for _ in range(_PASSES):
        moment = np.einsum("bm,mi,mj->bij", w, q, q)  # its first eigenvector is the mean (Markley et al. 2007)
        mean = Rotation.from_quat(np.linalg.eigh(moment)[1][:, :, -1])
        pairs = Rotation.from_quat(np.repeat(mean.as_quat(), m, axis=0)).inv() * Rotation.from_quat(np.tile(q, (b, 1)))
        tangent = pairs.as_rotvec().reshape(b, m, 3)
        value, slope = _line(lag, tangent, w)
        angle = np.linalg.norm(tangent - value[:, None] - slope[:, None] * lag[..., None], axis=2)
        w = base / (1 + (angle / _DOUBT) ** 2)
    R = (mean * Rotation.from_rotvec(value)).as_matrix()
    total = w.sum(axis=1)
    spread = np.sqrt((w * angle**2).sum(axis=1) / np.maximum(total, 1e-12))
    unknown = base.sum(axis=1) < _ENOUGH
    R[unknown], spread[unknown] = np.nan, np.nan
    return R, spread, total


def _line(lag: np.ndarray, y: np.ndarray, w: np.ndarray) -> tuple[Float[np.ndarray, "b 3"], Float[np.ndarray, "b 3"]]:
    """Weighted least squares y = value + slope * lag in each row."""
    total = np.maximum(w.sum(axis=1), 1e-12)
    x0 = (w * lag).sum(axis=1) / total
    y0 = np.einsum("bm,bmi->bi", w, y) / total[:, None]
    dx = lag - x0[:, None]
    slope = np.einsum("bm,bm,bmi->bi", w, dx, y - y0[:, None]) / ((w * dx**2).sum(axis=1) + _STIFF * total)[:, None]
    return y0 - slope * x0[:, None], slope
