"""People of many frames -> arrays, and what can be said of joints between the measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.special import gammainc, gammaincinv

from understudy.skeleton import N_JOINTS
from understudy.tracking.kalman import Measured
from understudy.types import INFERRED, MISSING, OBSERVED, Person

BALL: Final = float(np.sqrt(2 * gammaincinv(1.5, 0.6827)))
"""`sigma_m`, the radius of the ball that holds 68 %, in sigmas along one axis"""
NEAR_M: Final = 0.1
"""`confidence` is the probability of being nearer to the truth than this"""
_SHARPEST: Final = 0.002  # metres: no measurement is better
_SURE: Final = 0.999  # a confidence above counts as this, one below 1 - _SURE as that
_DOUBTFUL: Final = 0.5  # below this confidence a joint is rather not near the truth, whatever its sigma says


def measure(
    frames: Sequence[Mapping[int, Person]],
    ids: Sequence[int],
    times_s: Float[np.ndarray, " t"],
    before: Bool[np.ndarray, " b"],
    reach_s: float,
) -> tuple[Measured, Shaped[np.ndarray, "t b"]]:
    """Measurements of the joints of people, 18 for each id in turn, and their sources.

    before: whether a joint was seen before the first of these moments.
    """
    t, n = len(frames), len(ids)
    y, s = np.full((t, n, N_JOINTS, 3), np.nan), np.full((t, n, N_JOINTS), np.nan)
    source = np.full((t, n, N_JOINTS), MISSING, dtype=f"U{max(map(len, (OBSERVED, INFERRED, MISSING)))}")
    confidence = np.zeros((t, n, N_JOINTS))
    column = {id: i for i, id in enumerate(ids)}
    for k, people in enumerate(frames):
        for id, person in people.items():
            i = column[id]
            y[k, i], s[k, i], source[k, i] = person.keypoints, person.sigma_m, person.source
            confidence[k, i] = person.confidence
    seen = np.isfinite(y).all(axis=3)
    sigma = np.maximum(axis_sigma(s, confidence), _SHARPEST)
    return (
        _flat(np.where(seen[..., None], y, 0.0), np.where(seen, sigma, 1.0), seen, times_s, before, reach_s),
        source.reshape(t, -1),
    )


def _flat(
    y: np.ndarray, s: np.ndarray, seen: np.ndarray, times_s: np.ndarray, before: np.ndarray, reach_s: float
) -> Measured:
    t = len(y)
    seen = seen.reshape(t, -1)
    first = np.where(seen.any(axis=0), times_s[seen.argmax(axis=0)], np.inf)
    arrival = np.repeat(first.reshape(-1, N_JOINTS).min(axis=1), N_JOINTS)
    active = before | (times_s[:, None] >= np.maximum(first - reach_s, arrival))
    return Measured(y.reshape(t, -1, 3), s.reshape(t, -1), seen, active)


def axis_sigma(sigma_m: Float[np.ndarray, "*n"], confidence: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Sigma along one axis, metres: that of `sigma_m`; the one that `confidence` means where there is no `sigma_m`, or
    where the joint is doubtful and this one is larger.
    """
    said = np.asarray(sigma_m / BALL)
    asked = np.isnan(said) | ~(confidence >= _DOUBTFUL)
    sure = np.clip(np.nan_to_num(confidence[asked]), 1 - _SURE, _SURE)
    said[asked] = np.fmax(said[asked], NEAR_M / np.sqrt(2 * gammaincinv(1.5, sure)))
    return said


def confidence_of(sigma_m: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Probability of being within 10 cm of the truth; 0 where there is no sigma."""
    known = np.isfinite(sigma_m)
    return np.where(known, gammainc(1.5, 0.5 * (NEAR_M * BALL / np.where(known, sigma_m, 1.0)) ** 2), 0.0)


def within_reach(
    times_s: Float[np.ndarray, " t"],
    observed: Bool[np.ndarray, "t b"],
    before_s: Float[np.ndarray, " b"],
    reach_s: float,
) -> Bool[np.ndarray, "t b"]:
    """Where a measurement is at most `reach_s` away in time. before_s: the last one before these moments, or -inf."""
    at = times_s[:, None]
    last = np.maximum.accumulate(np.vstack([before_s[None], np.where(observed, at, -np.inf)]), axis=0)[1:]
    following = np.minimum.accumulate(np.where(observed, at, np.inf)[::-1], axis=0)[::-1]
    return (at - last <= reach_s) | (following - at <= reach_s)
