"""One even clock for everything. Tracks that were measured at other times are brought to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from understudy.errors import UnderstudyError
from understudy.trajectories import PlanarTrack, PoseTrack

LEAST_HZ: Final = 10.0
_UNEVEN = 0.05  # of a step: timestamps that are off by less are taken as they are
_NEAR = 0.6  # steps: a sample counts as measured when a measurement is so near
_LONGEST_S = 1.0  # between measurements that are joined by a straight line
_GROWTH = 0.10  # m/s and rad/s: of the sigma between measurements


def even_times(times_s: Sequence[float] | Float[np.ndarray, " n"], rate_hz: float | None = None) -> np.ndarray:
    """Evenly spaced seconds from the first to the last time.

    rate_hz: the recording's own rate if not given, but at least LEAST_HZ. Raises UnderstudyError when there are fewer
    than two times, or when they do not increase.
    """
    times = np.asarray(times_s, np.float64)
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise UnderstudyError(f"a demonstration needs two frames or more, at increasing times; got {len(times)} times")
    step = float(np.median(np.diff(times)))
    if rate_hz is None:
        rate_hz = max(LEAST_HZ, 1 / step)
    if not 0.1 <= rate_hz <= 1000:
        raise UnderstudyError(f"rate_hz {rate_hz}: must be in [0.1, 1000]")
    n = round((times[-1] - times[0]) * rate_hz) + 1
    even = times[0] + np.arange(n) / rate_hz
    if n == len(times) and np.abs(even - times).max() < _UNEVEN / rate_hz:
        return times[0] + np.arange(n) * (times[-1] - times[0]) / (n - 1)
    return even


def resample_poses(track: PoseTrack, times_s: Float[np.ndarray, " t"], at: Float[np.ndarray, " n"]) -> PoseTrack:
    """A pose track at other times: straight lines and even turns between its samples."""
    known = np.flatnonzero(track.known)
    T, covariance = np.full((len(at), 4, 4), np.nan), np.full((len(at), 6, 6), np.nan)
    low, high, share, valid = _between(times_s[known], at)
    if valid.any():
        a, b, s = known[low[valid]], known[high[valid]], share[valid]
        first = Rotation.from_matrix(track.T_world_x[a, :3, :3])
        turn = (first.inv() * Rotation.from_matrix(track.T_world_x[b, :3, :3])).as_rotvec()
        T[valid] = np.eye(4)
        T[valid, :3, :3] = (first * Rotation.from_rotvec(s[:, None] * turn)).as_matrix()
        p, q = track.positions[a], track.positions[b]
        T[valid, :3, 3] = p + s[:, None] * (q - p)
        covariance[valid] = _mixed(track.covariance, a, b, s, times_s, at[valid])
    observed, oriented = (_nearest(flags, times_s, at) & valid for flags in (track.observed, track.oriented))
    return PoseTrack(T, covariance, observed, oriented)


def resample_planar(track: PlanarTrack, times_s: Float[np.ndarray, " t"], at: Float[np.ndarray, " n"]) -> PlanarTrack:
    """A planar track at other times: straight lines between its samples."""
    known = np.flatnonzero(track.known)
    values, covariance = np.full((len(at), 3), np.nan), np.full((len(at), 3, 3), np.nan)
    low, high, share, valid = _between(times_s[known], at)
    if valid.any():
        a, b, s = known[low[valid]], known[high[valid]], share[valid]
        values[valid] = track.xy_yaw[a] + s[:, None] * (track.xy_yaw[b] - track.xy_yaw[a])
        covariance[valid] = _mixed(track.covariance, a, b, s, times_s, at[valid])
    return PlanarTrack(values, covariance, _nearest(track.observed, times_s, at) & valid)


def resample_points(
    points: Float[np.ndarray, "t k 3"], times_s: Float[np.ndarray, " t"], at: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n k 3"]:
    """Points at other times; NaN where one has no samples before and after within a second."""
    out = np.full((len(at), *points.shape[1:]), np.nan)
    for k in range(points.shape[1]):
        known = np.flatnonzero(np.isfinite(points[:, k]).all(axis=1))
        low, high, share, valid = _between(times_s[known], at)
        if valid.any():
            a, b = points[known[low[valid]], k], points[known[high[valid]], k]
            out[valid, k] = a + share[valid, None] * (b - a)
    return out


def _between(
    times: Float[np.ndarray, " m"], at: Float[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Neighbours in time, where between them, and whether they are near enough to say anything."""
    n = len(at)
    if not len(times):
        return np.zeros(n, int), np.zeros(n, int), np.zeros(n), np.zeros(n, bool)
    high = np.clip(np.searchsorted(times, at - 1e-9), 0, len(times) - 1)
    low = np.maximum(high - 1, 0)
    low = np.where(np.abs(times[high] - at) < 1e-9, high, low)
    gap = times[high] - times[low]
    share = np.where(gap > 0, (at - times[low]) / np.where(gap > 0, gap, 1), 0.0)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.1
    inside = (at >= times[0] - _NEAR * step) & (at <= times[-1] + _NEAR * step)
    return low, high, np.clip(share, 0, 1), inside & (gap <= max(_LONGEST_S, 2.5 * step))


def _mixed(
    covariance: np.ndarray, a: np.ndarray, b: np.ndarray, share: np.ndarray, times_s: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """Covariances between two samples, grown by how far away both are."""
    far = np.minimum(at - times_s[a], times_s[b] - at).clip(0)
    mixed = covariance[a] + share[:, None, None] * (covariance[b] - covariance[a])
    return np.asarray(mixed + (_GROWTH * far)[:, None, None] ** 2 * np.eye(covariance.shape[-1]))


def _nearest(flags: Bool[np.ndarray, " t"], times_s: np.ndarray, at: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Whether a flagged sample is near enough."""
    marked = times_s[flags]
    if not len(marked):
        return np.zeros(len(at), bool)
    step = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.1
    i = np.clip(np.searchsorted(marked, at), 1, max(len(marked) - 1, 1))
    near = np.minimum(np.abs(at - marked[np.minimum(i, len(marked) - 1)]), np.abs(at - marked[i - 1]))
    return np.asarray(near <= _NEAR * step)
