"""Smoothing of many points with outliers, and with a liveliness that is learnt for each.

The measurements' white noise is Student's t: each measurement is compared with what all the others say of its place,
and loses weight with the distance. How much a point accelerates is chosen by the likelihood of its measurements.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.tracking.kalman import K, Measured, Model, State, backward, diffuse, forward

_FREEDOM: Final = 4.0  # degrees, of Student's t
_PASSES: Final = 5
_LEARN_AFTER: Final = (
    1  # passes, the first is 0: gross outliers must have lost their weight, or they pass for liveliness
)
_GRID: Final = 10.0 ** np.arange(0.0, 5.1, 1.0)  # values of q to choose from, m^2/s^5
_USUAL: Final = 3000.0  # q of most joints
_DECADES: Final = 1.0  # by which q differs from the usual, one sigma
_NEARBY_S: Final = 2.0
_TINY: Final = 1e-12


@dataclass(frozen=True, eq=False)
class Past:
    """What is known of b points before the first moment of a window."""

    state: State
    grid: State
    """g * b points: a filter for each q of the grid"""
    log_likelihood: Float[np.ndarray, "g b"]
    """of everything measured so far, prior included"""

    @classmethod
    def none(cls, b: int) -> Past:
        """Before anything was seen."""
        prior = -0.5 * (np.log10(_GRID / _USUAL) / _DECADES) ** 2
        return cls(diffuse(b), diffuse(len(_GRID) * b), np.tile(prior[:, None], (1, b)))

    @classmethod
    def join(cls, parts: list[Past]) -> Past:
        """Of several groups of points, one behind the other."""
        g = len(_GRID)
        x = np.concatenate([p.grid.x.reshape(g, -1, K, 3) for p in parts], axis=1).reshape(-1, K, 3)
        P = np.concatenate([p.grid.P.reshape(g, -1, K, K) for p in parts], axis=1).reshape(-1, K, K)
        state = State(np.concatenate([p.state.x for p in parts]), np.concatenate([p.state.P for p in parts]))
        return cls(state, State(x, P), np.concatenate([p.log_likelihood for p in parts], axis=1))

    def split(self, size: int) -> list[Past]:
        """The inverse of `join` for groups of `size` points."""
        g, n = self.log_likelihood.shape
        x, P = self.grid.x.reshape(g, n, K, 3), self.grid.P.reshape(g, n, K, K)
        return [
            Past(
                State(self.state.x[i : i + size], self.state.P[i : i + size]),
                State(x[:, i : i + size].reshape(-1, K, 3), P[:, i : i + size].reshape(-1, K, K)),
                self.log_likelihood[:, i : i + size],
            )
            for i in range(0, n, size)
        ]


@dataclass(frozen=True, eq=False)
class Smoothed:
    """b points at t moments."""

    position: Float[np.ndarray, "t b 3"]
    """metres"""
    variance: Float[np.ndarray, "t b"]
    """along each axis, square metres"""
    weight: Float[np.ndarray, "t b"]
    """of the measurements: about 1, towards 0 for outliers; 0 where there is none"""
    past: Past
    """what is known after the first moment, without looking ahead: where the next window begins"""


def smooth_points(measured: Measured, model: Model, dt_s: Float[np.ndarray, " t"], past: Past) -> Smoothed:
    """Positions given all measurements. dt_s: since the moment before; of the first moment, since `past`."""
    weight, (h, R) = measured.seen.astype(np.float64), measured.rows(model)
    q, seen = liveliness(past.log_likelihood), measured.seen
    learnt = None
    for again in range(_PASSES):
        filtered = forward(measured, model, dt_s, q, weight, past.state)
        x, P = backward(filtered)
        if again == _PASSES - 1:
            break
        weight = np.where(seen, student(measured.y, h, R, weight, x, P), 0.0)
        if again == _LEARN_AFTER:
            learnt = _Likelihoods.of(measured, model, dt_s, weight, past)
            q = liveliness(past.log_likelihood + learnt.of_moment.sum(axis=0))
    assert learnt is not None
    first = State(filtered.x[0], filtered.P[0])
    after = Past(first, learnt.first, past.log_likelihood + learnt.of_moment[0])
    constant = model.constant_share * _nearby(measured, np.cumsum(dt_s))
    return Smoothed(x[:, :, 0].copy(), P[:, :, 0, 0] + constant, weight, after)


def student(
    y: Float[np.ndarray, "t b 3"],
    h: Float[np.ndarray, "t b 4"],
    R: Float[np.ndarray, "t b"],
    weight: Float[np.ndarray, "t b"],
    x: Float[np.ndarray, "t b 4 3"],
    P: Float[np.ndarray, "t b 4 4"],
) -> Float[np.ndarray, "t b"]:
    """New weights from smoothed states that were found with `weight`.

    The residual is taken to what the other measurements say (the leverage of a measurement on its own place is taken
    out), so a measurement cannot hide by pulling the track to itself.
    """
    residual = y - np.einsum("tbi,tbix->tbx", h, x)
    leverage = np.minimum(np.einsum("tbi,tbij,tbj->tb", h, P, h) * weight / R, 1 - 1e-9)
    others = R * leverage / np.maximum(weight, _TINY) / (1 - leverage)
    distance2 = (residual**2).sum(axis=2) / (1 - leverage) ** 2 / (R + others)
    return (_FREEDOM + 3) / (_FREEDOM + distance2)


def liveliness(log_likelihood: Float[np.ndarray, "g b"]) -> Float[np.ndarray, " b"]:
    """The mean q in decades under these likelihoods of the grid."""
    p = np.exp(log_likelihood - log_likelihood.max(axis=0))
    return 10.0 ** (np.log10(_GRID) @ (p / p.sum(axis=0)))


@dataclass(frozen=True, eq=False)
class _Likelihoods:
    of_moment: Float[np.ndarray, "t g b"]
    first: State

    @classmethod
    def of(
        cls, measured: Measured, model: Model, dt_s: np.ndarray, weight: Float[np.ndarray, "t b"], past: Past
    ) -> _Likelihoods:
        """Log likelihoods of the measurements at each moment for each q of the grid, by the filter's innovations."""
        g, (t, b) = len(_GRID), weight.shape
        many = Measured(
            *(np.tile(a, (1, g, 1)[: a.ndim]) for a in (measured.y, measured.s, measured.seen, measured.active))
        )
        filtered = forward(many, model, dt_s, np.repeat(_GRID, b), np.tile(weight, (1, g)), past.grid)
        h, R = many.rows(model)
        expected = np.einsum("tbi,tbix->tbx", h, filtered.x_before)
        S = np.einsum("tbi,tbij,tbj->tb", h, filtered.P_before, h) + R / np.maximum(np.tile(weight, (1, g)), _TINY)
        distance2 = ((many.y - expected) ** 2).sum(axis=2) / S
        ll = -0.5 * (_FREEDOM + 3) * np.log1p(distance2 / _FREEDOM) - 1.5 * np.log(S)
        ll = np.where(many.seen, ll, 0.0).reshape(t, g, b)
        return cls(ll, State(filtered.x[0], filtered.P[0]))


def _nearby(measured: Measured, times_s: Float[np.ndarray, " t"]) -> Float[np.ndarray, "t b"]:
    """Variance of the measurements around each moment: 1 / mean precision, weighted by nearness; 0 without any."""
    precision = np.where(measured.seen, measured.s**-2.0, 0.0)
    sums = np.stack([precision, measured.seen.astype(np.float64)])
    fade = np.exp(-np.diff(times_s) / _NEARBY_S)
    before, after = sums.copy(), sums.copy()
    for k in range(1, len(times_s)):
        before[:, k] += fade[k - 1] * before[:, k - 1]
        after[:, -k - 1] += fade[-k] * after[:, -k]
    total, count = before + after - sums
    return np.where(count > 0, count / np.maximum(total, 1e-300), 0.0)
